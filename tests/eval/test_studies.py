"""Test studies: their files are complete and state what was measured."""

import json
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.helpers.box_rooms import furniture, two_rooms
from tests.viz.hostile_text import KINDS, MARKUP, Change, changed, check_page, harmless, suffix
from vssm_gym.cli.studies import recordings as commands
from vssm_gym.data.recording import record_handheld
from vssm_gym.data.sequences import load_sequence
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError
from vssm_gym.eval.studies import resolution as study_resolution
from vssm_gym.eval.studies import runtime as study_runtime
from vssm_gym.eval.studies.map_update import _answer, _picture
from vssm_gym.eval.studies.page import Study, study_folder, write_study
from vssm_gym.eval.studies.page import page as study_page
from vssm_gym.inference.status import Status
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.run import TrackedFrame


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


def test_a_study_writes_three_files_and_the_page_is_self_contained(tmp_path) -> None:
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
    assert 'src="http' not in text
    stored = json.loads((tmp_path / "new" / "map-update.json").read_text())
    assert set(stored) == {"version", "machine", "setting", "figures"}
    assert stored["figures"]["closed form"]["ms_a_frame"] == 5.0
    assert stored["setting"] == {"n": 3}


def test_an_outcome_is_never_overwritten_and_may_lie_beside_others(tmp_path) -> None:
    with study_folder("flight", tmp_path):
        (tmp_path / "flight.svg").write_text("hours of work")
    with study_folder("runtime", tmp_path):
        (tmp_path / "runtime.json").write_text("{}")
        with pytest.raises(InputError, match="no other run writing to it"), study_folder("resolution", tmp_path):
            pass
    message = r"flight\.svg: file: expected a new file: this one is never overwritten"
    with pytest.raises(InputError, match=message), study_folder("flight", tmp_path):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flight.svg", "runtime.json", "study.json"]


def test_no_text_of_a_study_becomes_markup() -> None:
    """Sequences give names to rows, settings and notes; every field of a study is changed, those to come too."""
    study = Study("a", "b?", "c", ("d", "e"), [["f", "g"]], b"<svg/>", {"h": ["i", {"j": "k"}]}, {}, ("l", "m"))

    def shown(change: Change) -> str:
        texts = {field.name: changed(getattr(study, field.name), change) for field in fields(Study)}
        return study_page(Study(**texts), {"setting": texts["setting"], "version": change("0")})

    for text in KINDS.values():
        check_page(shown(suffix(text)), shown(harmless))
    assert MARKUP[0] in check_page(shown(suffix(MARKUP[0])), shown(harmless)).text


def test_a_study_with_nan_is_not_written(tmp_path) -> None:
    """JSON has no NaN, and a study that measured nothing must not look like a result."""
    study = Study("x", "q", "a", ("b",), [["c"]], b"<svg/>", {}, {"value": np.nan})
    with pytest.raises(ValueError, match="JSON"):
        write_study(study, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_answer_follows_the_figures() -> None:
    closed = arm(0, 5.0, 0.02)
    worse = {"closed form": closed, "4 steps": arm(4, 20.0, 0.01) | {"log_likelihood": 3.9}}
    assert "stays below" in _answer(worse)  # though its depth is better: the sentence says both
    assert "10.0 mm" in _answer(worse)
    better = worse | {"16 steps": arm(16, 80.0, 0.019) | {"log_likelihood": 4.1}}
    assert "is as good with 16 steps a frame: 4.10 nats in 80 ms, 16.0 times as long" in _answer(better)


@pytest.mark.parametrize(("field", "change"), [("frames", {"frames": 5}), ("voxel", {"voxel": 0.0})])
def test_bad_options_are_named(tmp_path, field: str, change: dict) -> None:
    with pytest.raises(InputError, match=field):
        commands.map_update(tmp_path, tmp_path / "out", **change)


@pytest.mark.slow
def test_the_study_on_a_real_sequence(shared_data, tmp_path) -> None:
    """The closed form is better than as many milliseconds of gradient descent (PRISM, fig. 6)."""
    commands.map_update(shared_data / "tum_fr1_xyz", tmp_path, size="80x60", frames=20, voxel=0.08)
    figures = json.loads((tmp_path / "map-update.json").read_text())["figures"]
    assert set(figures) == {"closed form", "1 steps", "4 steps", "16 steps", "64 steps"}
    assert figures["closed form"]["log_likelihood"] > figures["1 steps"]["log_likelihood"]


# A run of the filter, made by hand


def frame(index: int, **known: object) -> TrackedFrame:
    """Return a tracked frame after compilation; the first one has no belief, as in a real run."""
    first = TrackedFrame(index, 0.1 * index, np.eye(4), Status.OK, None, None, None, 1.0, 0.002, 0.0, 0.01,
                         {"track": 0.004, "map": 0.005}, index > 0, None, None, 0)  # fmt: skip
    return replace(first, **known)


def test_stages_add_up_to_the_mean_step() -> None:
    frames = [frame(i, step_s=0.010 + 0.002 * (i % 3 == 0), stages={"track": 0.004, "map": 0.005}
                    | ({"reference": 0.002} if i % 3 == 0 else {})) for i in range(61)]  # fmt: skip
    frames[30] = replace(frames[30], step_s=9.0)  # the machine was elsewhere: one of the slowest twentieth
    timed = study_runtime._timed(frames, SimpleNamespace(root=Path("room")))
    assert timed["ms"]["step"]["p50"] == pytest.approx(10.0)
    assert timed["ms"]["reference"] == {"p50": pytest.approx(2.0), "p95": pytest.approx(2.0), "n": 20}
    assert timed["ms"]["rest"]["p50"] == pytest.approx(1.0)
    assert sum(timed["mean_ms"].values()) == pytest.approx((40 * 10 + 19 * 12) / 59)
    assert timed["mean_ms"]["reference"] == pytest.approx(19 * 2 / 59)
    assert "recover" not in timed["ms"]
    with pytest.raises(InputError, match="frames"):
        study_runtime._timed(frames[:1], SimpleNamespace(root=Path("room")))


def test_one_setting_is_varied_at_a_time() -> None:
    chosen = study_runtime.settings((320, 200), 10.0)
    assert [value for varied, value in chosen if varied == "image"] == ["80x60", "160x120"]  # no larger than recorded
    default = SlamOptions()
    for options in chosen.values():
        changed = [n for n in ("size", "voxel", "extent", "rate") if getattr(options, n) != getattr(default, n)]
        assert len(changed) <= 1
    assert {varied for (varied, _), options in chosen.items() if options == default} == {"image", "cell", "extent"}


def one_run(ate: float | None, lost: int = 0, ms: float = 10.0) -> dict:
    return {"ate_m": ate, "max_m": ate and 2 * ate, "frames": 50, "lost": lost, "steps_ms": [ms, ms + 1.0, ms + 2.0]}


def test_the_resolution_table_shows_the_worst_run() -> None:
    arm = study_resolution._summary([one_run(0.01), one_run(0.03, lost=4)])
    assert (arm["ate_m"], arm["max_m"], arm["lost"], arm["step_ms"]) == (0.02, 0.06, 4, 11.0)
    assert study_resolution._text("ate_m", arm) == "2.00 (1.00 to 3.00)"
    assert study_resolution._text("lost", arm) == "4 of 50"
    failed = study_resolution._summary([one_run(0.01), one_run(None, lost=50)])
    assert failed["ate_m"] is None  # the run that ended well does not stand for both
    assert [study_resolution._text(name, failed) for name in ("ate_m", "max_m", "lost")] == ["-", "-", "50 of 50"]


def test_the_resolution_answer_prefers_settings_without_lost_frames() -> None:
    def of(voxel: float, *runs: dict) -> dict:
        return {"voxel": voxel, "render_width": 160} | study_resolution._summary(list(runs))

    lossy, best, fast = of(0.04, one_run(0.01, lost=9)), of(0.07, one_run(0.020)), of(0.1, one_run(0.021, ms=5.0))
    answer = study_resolution._answer([lossy, best, fast])
    assert answer.startswith("Most accurate: cells of 7 cm")
    assert "its error: cells of 10 cm tracked at 160 pixels (ATE 2.10 cm, 6.0 ms a step, 0 of 50 lost)" in answer
    assert "nothing faster" in study_resolution._answer([best, of(0.1, one_run(0.05, ms=5.0))])
    assert study_resolution._answer([of(0.04, one_run(None))]) == "No setting tracked the camera."
    assert study_resolution._picture([lossy, best, fast, of(0.12, one_run(None))]).startswith(b"<?xml")


@pytest.mark.parametrize(
    ("run", "complaint"),
    [
        (lambda folder, out: commands.resolution(folder, out, seeds=0), "seeds"),
        (lambda folder, out: commands.resolution(folder, out, voxels="0.04;0.07"), "voxels"),
        (lambda folder, out: commands.resolution(folder, out, render_widths="80,wide"), "render-widths"),
        (lambda folder, out: commands.resolution(folder, out, voxels="0.07,-1"), "voxel"),
        (lambda folder, out: commands.resolution(folder, out, render_widths="8"), "render-width"),
        (lambda folder, out: commands.runtime(folder, out, rate=0.0), "rate"),
    ],
)
def test_a_bad_option_of_a_filter_study_writes_nothing(walk, tmp_path, run, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        run(walk, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_without_ground_truth_accuracy_is_refused(walk, tmp_path) -> None:
    blind = replace(load_sequence(walk), truth=None)
    settings = {"voxels": (0.07,), "render_widths": (160,), "size": (160, 120), "rate": 10.0, "seeds": 1}
    with pytest.raises(InputError, match=r"groundtruth\.txt"):
        study_resolution.run(blind, **settings)


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> Path:
    """Record a walk of a metre through a small apartment, images of 160x120."""
    folder = tmp_path_factory.mktemp("study")
    table = furniture("table", (1.5, 2.0, 0.25), (0.6, 0.6, 0.5))
    save_scene(two_rooms(pieces=(table,)), folder / "rooms.json")
    record_handheld(folder / "rooms.json", folder / "walk", metres=1.0, camera=CameraConfig(160, 120))
    return folder / "walk"


@pytest.mark.slow
def test_the_studies_of_the_filter(walk, tmp_path, monkeypatch) -> None:
    """Each runs completely from its command; on a noise-free walk the filter stays close and is never lost."""
    commands.resolution(walk, tmp_path, voxels="0.07", render_widths="80,160", seeds=2)
    arms = json.loads((tmp_path / "resolution.json").read_text())["figures"]["arms"]
    assert [(arm["voxel"], arm["render_width"]) for arm in arms] == [(0.07, 80), (0.07, 160)]
    assert all(arm["lost"] == 0 and 0.0 < arm["ate_m"] < 0.05 and arm["step_ms"] > 0.0 for arm in arms)
    monkeypatch.setattr(study_runtime, "VOXELS", (0.07,))
    monkeypatch.setattr(study_runtime, "EXTENTS", (14.0,))
    commands.runtime(walk, tmp_path)
    arms = json.loads((tmp_path / "runtime.json").read_text())["figures"]["arms"]
    assert [arm["value"] for arm in arms] == ["80x60", "160x120", "7 cm", "14 m"]
    assert {"step", "read", "track", "map", "reference", "rest"} <= set(arms[0]["ms"])
    assert arms[1]["ms"] == arms[2]["ms"]  # the default is run once and stands in every group
