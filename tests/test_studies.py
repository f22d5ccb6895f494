"""Studies: what is written is whole and says what was measured."""

import json

import numpy as np
import pytest

from vssm_gym.cli.study import map_update
from vssm_gym.errors import InputError
from vssm_gym.eval.studies import Study, write_study
from vssm_gym.eval.study_map_update import _answer, _picture


def arm(steps: int, ms: float, depth: float) -> dict:
    return {
        "steps": steps,
        "ms_a_frame": ms,
        "depth_l1": depth,
        "depth_median": depth,
        "colour_l1": 0.05,
        "log_likelihood": 4.0,
        "hit_share": 1.0,
    }


def test_three_files_and_the_page_needs_no_other(tmp_path) -> None:
    arms = {"closed form": arm(0, 5.0, 0.02), "4 steps": arm(4, 20.0, 0.03)}
    study = Study(
        "map-update", "Which is <faster>?", "This one.", ("way", "ms"), [["a", "1"]], _picture(arms), {"n": 3}, arms
    )
    page = write_study(study, tmp_path / "new")
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == [
        "map-update.html",
        "map-update.json",
        "map-update.svg",
    ]
    text = page.read_text()
    assert "Which is &lt;faster&gt;?" in text
    assert "data:image/svg+xml;base64," in text
    assert "src='http" not in text
    stored = json.loads((tmp_path / "new" / "map-update.json").read_text())
    assert stored["figures"]["closed form"]["ms_a_frame"] == 5.0
    assert stored["setting"] == {"n": 3}
    assert write_study(study, tmp_path / "new") == page  # again, in place


def test_a_number_that_is_none_is_not_written(tmp_path) -> None:
    """JSON has no NaN: a study that measured nothing must not look like a result."""
    study = Study("x", "q", "a", ("b",), [["c"]], b"<svg/>", {}, {"value": np.nan})
    with pytest.raises(ValueError, match="JSON"):
        write_study(study, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_answer_follows_the_figures() -> None:
    closed = arm(0, 5.0, 0.02)
    worse = {"closed form": closed, "4 steps": arm(4, 20.0, 0.01) | {"log_likelihood": 3.9}}
    assert "does not get there" in _answer(worse)  # though its depth is better: the sentence says both
    assert "10.0 mm" in _answer(worse)
    better = worse | {"16 steps": arm(16, 80.0, 0.019) | {"log_likelihood": 4.1}}
    assert "is as good with 16 steps a frame: 4.10 nats in 80 ms, 16.0 times as long" in _answer(better)


@pytest.mark.parametrize(("field", "change"), [("frames", {"frames": 5}), ("voxel", {"voxel": 0.0})])
def test_bad_options_are_named(tmp_path, field: str, change: dict) -> None:
    with pytest.raises(InputError, match=field):
        map_update(tmp_path, tmp_path / "out", **change)


@pytest.mark.slow
def test_the_study_on_a_real_sequence(shared_data, tmp_path) -> None:
    """The closed form is better than as many milliseconds of gradient descent (PRISM, fig. 6)."""
    map_update(shared_data / "tum_fr1_xyz", tmp_path, size="80x60", frames=40, voxel=0.08)
    figures = json.loads((tmp_path / "map-update.json").read_text())["figures"]
    assert set(figures) == {"closed form", "1 steps", "4 steps", "16 steps", "64 steps"}
    assert figures["closed form"]["log_likelihood"] > figures["1 steps"]["log_likelihood"]
