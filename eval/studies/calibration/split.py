"""Divide scenes and seeds: those that filters may be tuned on, and those that they are judged on.

===========  ====================================  ===================================================
             train                                 test
===========  ====================================  ===================================================
apartments   fern, ivy, moss, reed, procedural:0   birch, cedar, elm, oak, walnut, procedural:10000
known map    fern, reed                            cedar, oak
car          garage, paddock                       arena, depot
flight       star, clover, in the hall             figure8, picasso, in the hall
seeds        of NumPy's stream 1                   of NumPy's stream 2
===========  ====================================  ===================================================

The apartments are those of the splits that agents are trained and tested in (:mod:`vssm_gym.envs.tasks.splits`). All
built-in arenas of the car and the hall are scenes of its test split; they are divided here for this study alone. A
seed of ``--seed S`` in one split is never one of the other.
"""

from dataclasses import dataclass

import numpy as np

from vssm_gym.envs.tasks.navigation import Split


@dataclass(frozen=True)
class Division:
    """Hold the scenes of one split."""

    apartments: tuple[str, ...]
    mapped: tuple[str, ...]  # apartments whose map is learned before
    arenas: tuple[str, ...]
    flights: tuple[str, ...]  # reference curves, all flown in the hall
    stream: int  # of the seeds


DIVISIONS: dict[Split, Division] = {
    "train": Division(
        ("fern", "ivy", "moss", "reed", "procedural:0"), ("fern", "reed"), ("garage", "paddock"), ("star", "clover"), 1
    ),
    "test": Division(
        ("birch", "cedar", "elm", "oak", "walnut", "procedural:10000"),
        ("cedar", "oak"),
        ("arena", "depot"),
        ("figure8", "picasso"),
        2,
    ),
}


def seed_of(split: Split, seed: int, number: int) -> int:
    """Return the 31-bit seed of run ``number`` of a row; its last bit tells the split, so that none is in both."""
    drawn = int(np.random.SeedSequence([DIVISIONS[split].stream, seed, number]).generate_state(1)[0])
    return (drawn >> 2 << 1) | (split == "test")
