"""One random generator for each thing that is random, so that one's use never shifts another's."""

import numpy as np

STREAMS = ("scene", "task", "dynamics", "sensors")


def seeded_streams(seed: int | None, names: tuple[str, ...] = STREAMS) -> dict[str, np.random.Generator]:
    """Generators of ``names``, independent children of ``seed``; fresh entropy where it is None."""
    children = np.random.SeedSequence(seed).spawn(len(names))
    return {name: np.random.default_rng(child) for name, child in zip(names, children, strict=True)}
