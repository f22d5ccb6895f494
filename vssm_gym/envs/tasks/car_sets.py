"""Make, save and load frozen sets of the car's tasks: a chain of targets, each of which starts at the one before.

Target ``i`` is drawn from a stream of its own, seeded by (scene, split, kind of target, i): a longer set begins with
the shorter one, and no split shares a stream with another.
"""

import hashlib
import json
from pathlib import Path
from typing import Literal

import numpy as np

from vssm_gym.envs.scenes.content_hash import content_hash
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.tasks.car import CarTask, CarTaskSampler, Targets
from vssm_gym.envs.tasks.navigation import Split, read
from vssm_gym.envs.validation import StrictModel
from vssm_gym.files.atomic import atomic_write
from vssm_gym.geometry.car import Car


class CarTaskSet(StrictModel):
    """Hold the tasks of one scene, kind of target and split; ``hash`` is :meth:`content_hash`, verified on loading."""

    format: Literal[1] = 1
    scene: str
    scene_hash: str
    targets: Targets
    split: Split
    tasks: tuple[CarTask, ...]
    hash: str = ""

    def content_hash(self) -> str:
        """Return the first 16 hex digits of the SHA-256 of the canonical JSON without ``hash``."""
        return content_hash(self, without="hash")


def make_car_tasks(apartment: Apartment, n: int, targets: Targets = "poses", split: Split = "test") -> CarTaskSet:
    """Make a chain of ``n`` targets; raise :class:`InputError` for an arena without room for a car."""
    sampler = CarTaskSampler.of(apartment, Car())
    key = hashlib.sha256(f"{apartment.name}|car|{targets}|{split}".encode()).digest()
    entropy = [int.from_bytes(key[i : i + 4], "little") for i in range(0, 16, 4)]
    tasks: list[CarTask] = []
    for i in range(n):
        rng = np.random.default_rng([*entropy, i])
        if not tasks:
            # The chain runs through poses; a set of points does not store the headings in between.
            tasks.append(sampler.draw(rng, "poses", i))
        else:
            tasks.append(sampler.goal_from(rng, np.array(tasks[-1].goal), "poses", i))
    if targets == "points":
        tasks = [task.model_copy(update={"goal": task.goal[:2]}) for task in tasks]
    made = CarTaskSet(
        scene=apartment.name,
        scene_hash=apartment.content_hash(),
        targets=targets,
        split=split,
        tasks=tuple(tasks),
    )
    return made.model_copy(update={"hash": made.content_hash()})


def save(tasks: CarTaskSet, path: Path) -> None:
    """Write as JSON, atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(tasks.model_dump(mode="json"), indent=1) + "\n", encoding="utf-8")


def load(path: Path, apartment: Apartment | None = None) -> CarTaskSet:
    """Return the task set in a file; raise as :func:`vssm_gym.envs.tasks.navigation.read`."""
    return read(CarTaskSet, path, apartment)
