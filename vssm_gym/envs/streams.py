"""Give each source of randomness a generator of its own, so that using one never shifts another."""

import zlib

import numpy as np

STREAMS = ("scene", "task", "dynamics", "sensors")

# Children of the seed that have a number. A stream of any other name is the child of its name, so that it is the same
# whatever else there is. The scanner of the robots and the IMU of the multirotor are never in one environment.
_NUMBERS = {"scene": 0, "task": 1, "dynamics": 2, "sensors": 3, "lidar": 4, "imu": 4}
_NAMED = 6  # the child whose children are the streams without a number


def seeded_streams(seed: int | None, names: tuple[str, ...] = STREAMS) -> dict[str, np.random.Generator]:
    """Return generators of ``names``, independent children of ``seed``; fresh entropy where it is None."""
    entropy = np.random.SeedSequence(seed).entropy
    return {name: np.random.default_rng(np.random.SeedSequence(entropy, spawn_key=_key(name))) for name in names}


def _key(name: str) -> tuple[int, ...]:
    return (_NUMBERS[name],) if name in _NUMBERS else (_NAMED, zlib.crc32(name.encode()))
