"""Run rows of the studies again that store one table: calibration, smoothing, relocalisation.

Rows of recordings are left out, which the package does not hold.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from vssm_gym.errors import InputError
from vssm_gym.eval.reproduction.study_rows import StudyRows
from vssm_gym.eval.studies import relocalisation
from vssm_gym.eval.studies.calibration import study as calibration
from vssm_gym.eval.studies.calibration.rows import ROWS
from vssm_gym.eval.studies.smoothing import study as smoothing
from vssm_gym.files.json_file import read_json

SPENT = "seconds"  # a field, or the end of its name, that says how long the computer took
RELOCALISED = ("scenes", "sensors", "poses", "seed")  # of the setting of relocalisation, beside the spacing
Row = Mapping[str, Any]


def _stored(path: Path, setting: set[str], figures: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return setting and figures of a study's file; others than these fields are not this study's."""
    stored = read_json(path, expected="the outcome of a study")
    parts = [stored.get(name) if isinstance(stored, dict) else None for name in ("setting", "figures")]
    if not isinstance(parts[0], dict) or not isinstance(parts[1], dict) or parts[0].keys() != setting:
        raise InputError(path, "setting", f"that of a study, {', '.join(sorted(setting))}")
    if missing := [name for name in figures if name not in parts[1]]:
        raise InputError(path, f"figures.{missing[0]}", "the rows of a study; it is missing")
    return parts[0], parts[1]


def _timeless(value: Any) -> Any:
    """Return figures without those that say how long the computer took."""
    if isinstance(value, Mapping):
        return {name: _timeless(one) for name, one in value.items() if not name.endswith(SPENT)}
    return [_timeless(one) for one in value] if isinstance(value, list | tuple) else value


def _calibration_rows(path: Path) -> list[dict[str, Any]]:
    setting, figures = _stored(path, {field.name for field in fields(calibration.Setting)} | {"scenes"}, ("rows",))
    own = {name: value for name, value in setting.items() if name != "scenes"}
    return [{"row": name, "setting": own, **_timeless(row)} for name, row in figures["rows"].items() if name in ROWS]


def _calibration(row: Row) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="vssm-gym-calibration-") as folder:
        found = calibration.measure_row(row["row"], calibration.Setting(**row["setting"]), Path(folder))
    return dict(_timeless(found))


def _smoothing_rows(path: Path) -> list[dict[str, Any]]:
    setting, figures = _stored(path, {field.name for field in fields(smoothing.Setting)}, ("rows",))
    known = smoothing.simulated_recordings(smoothing.Setting(**setting))
    rows = {name: row for name, row in figures["rows"].items() if name in known}
    return [{"row": name, "setting": setting, **_timeless(row)} for name, row in rows.items()]


def _smoothing(row: Row) -> dict[str, Any]:
    record = smoothing.simulated_recordings(smoothing.Setting(**row["setting"]))[row["row"]]
    return dict(_timeless(smoothing.measure_simulated(record)))


def _relocalisation_rows(path: Path) -> list[dict[str, Any]]:
    """Return a row for each scene: its places, and what became of each image."""
    setting, figures = _stored(path, {*RELOCALISED, "spacing"}, ("index", "queries"))
    return [
        {
            "row": scene,
            "setting": setting,
            "places": figures["index"][scene]["places"],
            "queries": _timeless([query for query in figures["queries"] if query["scene"] == scene]),
        }
        for scene in setting["scenes"]
    ]


def _relocalisation(row: Row) -> dict[str, Any]:
    sensors, poses, seed = (row["setting"][name] for name in RELOCALISED[1:])
    with tempfile.TemporaryDirectory(prefix="vssm-gym-relocalisation-") as folder:
        found = relocalisation.run([row["row"]], Path(folder), sensors=sensors, poses=poses, seed=seed).figures
    return {"places": found["index"][row["row"]]["places"], "queries": _timeless(found["queries"])}


SETTING = frozenset({"setting"})  # says what ran, as the row's name does
TABLES = (
    StudyRows("calibration", "calibration*.json", ("row",), _calibration, SETTING, _calibration_rows),
    StudyRows("smoothing", "smoothing.json", ("row",), _smoothing, SETTING, _smoothing_rows),
    StudyRows("relocalisation", "relocalisation.json", ("row",), _relocalisation, SETTING, _relocalisation_rows),
)
"""The studies of one table each, by the file and the names of its rows."""
