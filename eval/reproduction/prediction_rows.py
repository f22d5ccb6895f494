"""Run rows of ``bench prediction`` again: a model on the drives of a split, at all horizons.

Rows of recorded motions are left out: their files need a recording and a learned transition.
"""

import tempfile
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from vssm_gym.envs.tasks.navigation import SPLITS, Split
from vssm_gym.errors import InputError, one_of
from vssm_gym.eval.bench.prediction.measure import score_models
from vssm_gym.eval.bench.prediction.models import models
from vssm_gym.eval.bench.prediction.run import MappedDrive, mapped_drives
from vssm_gym.eval.reproduction.study_rows import StudyRows
from vssm_gym.files.json_file import read_json

SETTING = ("split", "runs", "seed")  # of the stored setting: what has to be said to drive again
Row = Mapping[str, Any]


def _rows(path: Path) -> list[dict[str, Any]]:
    """Return a row for each model: what it scored at each horizon."""
    stored = read_json(path, expected="the outcome of bench prediction")
    setting = stored.get("setting") if isinstance(stored, dict) else None
    if not isinstance(setting, dict) or not set(SETTING) <= setting.keys() or not isinstance(stored.get("rows"), list):
        raise InputError(path, "setting", f"that of bench prediction, {', '.join(SETTING)}, and its rows")
    names = dict.fromkeys(row["model"] for row in stored["rows"])
    return [
        {
            "model": name,
            "setting": {field: setting[field] for field in SETTING},
            "horizons": [row for row in stored["rows"] if row["model"] == name],
        }
        for name in names
    ]


@lru_cache(maxsize=1)
def _drives(split: Split, runs: int, seed: int) -> list[MappedDrive]:
    """Return the drives, for all models: their maps are learned anew."""
    with tempfile.TemporaryDirectory(prefix="vssm-gym-prediction-") as folder:
        return list(mapped_drives(split, runs, seed, Path(folder)))


def _again(row: Row) -> dict[str, Any]:
    split, runs, seed = (row["setting"][name] for name in SETTING)
    if split not in SPLITS:
        raise InputError("bench prediction", "split", one_of(SPLITS, split))
    known = {model.name: model for model in models()}
    if row["model"] not in known:
        raise InputError("bench prediction", "model", one_of(known, row["model"]))
    return {"horizons": score_models([known[row["model"]]], _drives(split, runs, seed), split=split, seed=seed)}


PREDICTION = StudyRows("prediction", "test.json", ("model",), _again, frozenset({"setting"}), _rows)
"""The rows of ``bench prediction --split test``, by their file."""
