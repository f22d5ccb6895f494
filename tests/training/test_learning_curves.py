"""Test ``vssm-gym curves``: reading of trainings, figures and tables, and refused input."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from vssm_gym.errors import InputError
from vssm_gym.eval.metrics.aggregate import bootstrap_mean
from vssm_gym.training.learning_curves import CURVE_POINTS, curve, figure, grouped, read_training, speed, time_to

Point = tuple[float, float, float]  # seconds, steps, success


def run(
    folder: Path, points: list[Point], name: str = "imagined", seed: int = 0, world: str = "0" * 16, **config: Any
) -> Path:
    """Write a folder as `vssm-gym train` does; the return is 10 x success - 5; all robots' episode has 100 steps."""
    folder.mkdir(parents=True)
    where = {"id": "vssm_gym/WorldModelNav-v0", "map": f"{folder}.npz", "num_envs": 4, "max_episode_steps": 25}
    settings = {"name": name, "environment": where, "algorithm": {"name": "ppo"}, "steps": 10**6, "seed": seed} | config
    (folder / "training.json").write_text(json.dumps({"config": settings, "world_hash": world}))
    lines = [
        {"seconds": seconds, "steps": steps, "episodes": 7, "return": 10.0 * success - 5.0, "success": success}
        for seconds, steps, success in points
    ]
    (folder / "progress.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def straight(minutes: float, steps: float, last: float) -> list[Point]:
    """Return success that grows linearly from 0 at 100 steps and zero time."""
    return [(0.0, 100, 0.0), (30.0 * minutes, 100 + 0.5 * (steps - 100), 0.5 * last), (60.0 * minutes, steps, last)]


def test_a_training_is_read_from_where_all_robots_had_an_episode(tmp_path):
    """Ninety steps are fewer than four robots' whole episodes, and the success of one short episode is no estimate."""
    points = [(10.0, 0, 0.0), (20.0, 90, 1.0), (30.0, 100, 0.25), (60.0, 200, 0.75)]
    folder = run(tmp_path / "a", points)
    with (folder / "progress.jsonl").open("a") as file:
        file.write('{"seconds": 90.0, "ste')  # being written
    one = read_training(folder)
    np.testing.assert_allclose(one.minutes, [0.5, 1.0])
    np.testing.assert_allclose(one.steps, [100, 200])
    np.testing.assert_allclose(one.success, [0.25, 0.75])
    np.testing.assert_allclose(one.returns, [-2.5, 2.5])
    assert (one.name, one.seed) == ("imagined", 0)


def test_lines_before_the_first_episode_are_no_success(tmp_path):
    folder = run(tmp_path / "a", [(60.0, 200, 0.5), (120.0, 300, 0.5)])
    unknown = {"seconds": 1.0, "steps": 150, "episodes": 0, "return": None, "length": None, "success": None}
    text = (folder / "progress.jsonl").read_text()
    (folder / "progress.jsonl").write_text(json.dumps(unknown) + "\n" + text)
    assert len(read_training(folder).success) == 2


def test_times_by_hand(tmp_path):
    """With 0.8 after ten minutes and 1100 steps, a half is reached after 6.25 minutes and 725 steps, 0.9 never."""
    one = read_training(run(tmp_path / "a", straight(10.0, 1100, 0.8)))
    np.testing.assert_allclose(time_to(one, 0.5), (6.25, 725.0))
    assert time_to(one, 0.9) == (math.inf, math.inf)
    assert time_to(one, 0.0) == (0.0, 100.0)
    back = read_training(run(tmp_path / "b", [(0, 100, 0.0), (60, 200, 0.6), (120, 300, 0.2), (180, 400, 1.0)]))
    np.testing.assert_allclose(time_to(back, 0.6), (1.0, 200.0))  # the first time counts


def test_a_curve_is_the_mean_as_far_as_all_seeds_go(tmp_path):
    """The mean of slopes 0.1 and 0.05 a minute is 0.075, from the later start to the earlier end."""
    long = [(0.0, 100, 0.0), (600.0, 1100, 1.0)]
    late = [(120.0, 300, 0.1), (480.0, 900, 0.4)]
    group = [read_training(run(tmp_path / str(i), points, seed=i)) for i, points in enumerate((long, late))]
    found = curve(group, "success", "minutes")
    assert (found.x[0], found.x[-1], len(found.x)) == (2.0, 8.0, CURVE_POINTS)
    np.testing.assert_allclose(found.mean, 0.075 * found.x, atol=1e-12)
    middle = CURVE_POINTS // 2
    by_hand = bootstrap_mean([0.5, 0.25], [0, 1])
    assert (found.low[middle], found.high[middle]) == (by_hand.low, by_hand.high)
    assert (found.low <= found.mean).all() and (found.mean <= found.high).all()
    np.testing.assert_allclose(curve(group, "returns", "minutes").mean, 10.0 * found.mean - 5.0, atol=1e-9)
    by_steps = curve(group, "success", "steps")
    np.testing.assert_allclose([by_steps.x[0], by_steps.x[-1]], [300.0, 900.0])
    np.testing.assert_allclose(np.diff(np.log(by_steps.x)), math.log(3.0) / (CURVE_POINTS - 1))
    np.testing.assert_allclose(by_steps.mean, 0.5 * ((by_steps.x - 100.0) / 1000.0 + (by_steps.x - 100.0) / 2000.0))


def test_one_seed_has_a_line_and_no_interval(tmp_path):
    group = [read_training(run(tmp_path / "a", straight(10.0, 1100, 0.8)))]
    found = curve(group, "success", "minutes")
    assert np.isnan(found.low).all() and np.isfinite(found.mean).all()
    panels = figure({"imagined": group}).axes
    assert [len(axes.collections) for axes in panels] == [0, 0, 0, 0]
    two = figure({"imagined": [*group, read_training(run(tmp_path / "b", straight(9.0, 1000, 0.9), seed=1))]}).axes
    assert [len(axes.collections) for axes in two] == [1, 1, 1, 1]
    assert [axes.get_xscale() for axes in two] == ["linear", "log", "linear", "log"]


@pytest.mark.parametrize(
    ("lasts", "minutes", "reached"),
    [
        ((1.0, 0.8, 0.5), 6.25, 3),  # after 5, 6.25 and 10 minutes
        ((1.0, 0.8, 0.4), 6.25, 2),  # most of them
        ((1.0, 0.4, 0.4), math.inf, 1),
        ((1.0, 0.4), math.inf, 1),  # half of them: the median is nothing finite
    ],
)
def test_seeds_that_never_succeed_count_in_the_median(tmp_path, lasts, minutes, reached):
    group = [read_training(run(tmp_path / str(i), straight(10.0, 1100, last), seed=i)) for i, last in enumerate(lasts)]
    found = speed("imagined", group)
    assert found.minutes[0] == pytest.approx(minutes)
    assert found.reached == (reached, 1)
    assert found.last.mean == pytest.approx(np.mean(lasts))


# the command


@pytest.mark.parametrize("kind", ["svg", "png"])
def test_trainings_become_a_picture_and_a_table(vssm, tmp_path, kind):
    folders = [run(tmp_path / f"i{s}", straight(10.0 + s, 11_000_100, 1.0), seed=s) for s in range(3)]
    folders += [run(tmp_path / f"s{s}", straight(20.0, 100_100, 0.6 + 0.2 * s), "simulated", s) for s in range(2)]
    out = tmp_path / f"curves.{kind}"
    code, printed, err = vssm("curves", *folders, "--out", out)
    assert (code, err) == (0, "")
    rows = {line.split()[0]: line.split() for line in printed.splitlines() if line.split()[0] in (
        "imagined", "simulated",
    )}  # fmt: skip
    assert rows["imagined"][1:6] == ["3", "5.5", "5.5M", "9.9", "9.9M"]
    assert rows["imagined"][6:] == ["0.91", "[0.83,", "1.00]"]  # after the ten minutes that all three have
    assert rows["simulated"][1:6] == ["2", "14.6", "73.0k", "never", "never"]
    assert printed.splitlines()[-1].endswith(f"curves.{kind}")
    if kind == "svg":
        assert out.read_text().startswith("<?xml")
        before = out.read_bytes()
        assert vssm("curves", *folders, "--out", out)[0] == 0
        assert out.read_bytes() == before  # equal trainings, equal picture
    else:
        assert np.asarray(Image.open(out).convert("RGB")).std() > 5.0
    assert not list(tmp_path.glob(".*"))


def broken(folder: Path, what: str) -> list[Path]:
    """Write folders that cannot be drawn, one of each kind."""
    good = straight(10.0, 1100, 0.8)
    if what == "missing":
        return [folder / "nowhere"]
    if what == "other":
        (folder / "sweep").mkdir()
        (folder / "sweep" / "sweep.json").write_text("{}")
        return [folder / "sweep"]
    if what == "twice":
        return [run(folder / "a", good), run(folder / "b", good)]
    if what == "mixed":
        return [run(folder / "a", good), run(folder / "b", good, seed=1, minutes=3.0)]
    if what == "map":
        return [run(folder / "a", good), run(folder / "b", good, seed=1, world="1" * 16)]
    if what == "apart":
        return [run(folder / "a", good), run(folder / "b", [(900.0, 300, 0.1), (999.0, 400, 0.2)], seed=1)]
    one = run(folder / "a", good, **({"algorithm": {"name": "bc"}} if what == "cloned" else {}))
    progress = one / "progress.jsonl"
    lines = progress.read_text().splitlines()
    texts = {
        "empty": "",
        "early": lines[0] + "\n",
        "text": "seconds,steps\n",
        "list": "[1, 2]\n",
        "words": lines[0].replace('"success": 0.0', '"success": "none"') + "\n",
        "half": lines[0].replace('"success": 0.0', '"success": null') + "\n",
        "back": "\n".join(reversed(lines)) + "\n",
        "cloned": '{"seconds": 9.0, "steps": 200, "episodes": 0, "return": null, "success": null}\n',
    }
    if what in texts:
        progress.write_text(texts[what])
    elif what == "no progress":
        progress.unlink()
    elif what == "algorithm":
        manifest = json.loads((one / "training.json").read_text())
        manifest["config"]["algorithm"] = "ppo"
        (one / "training.json").write_text(json.dumps(manifest))
        progress.write_text("")
    elif what == "manifest":
        (one / "training.json").write_text('{"config": 3}')
    return [one]


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("missing", "nowhere: folder: expected a folder of `vssm-gym train`, which has a training.json"),
        ("other", "sweep: folder: expected a folder of `vssm-gym train`"),
        ("manifest", "training.json: file: expected the JSON that `vssm-gym train` wrote"),
        ("algorithm", "training.json: file: expected the JSON that `vssm-gym train` wrote"),
        ("no progress", "progress.jsonl: file: expected the progress of a training"),
        ("empty", "two lines with a success rate at least, written after a first episode of all robots has ended (100"),
        ("early", "found 1"),
        ("cloned", "cloning (bc) has no success rate until it is evaluated"),
        ("text", "progress.jsonl: line 1: expected a row of progress as JSON"),
        ("list", "progress.jsonl: line 1: expected a row of progress as a JSON object"),
        ("words", "progress.jsonl: line 1: expected numbers as success and return"),
        ("half", "progress.jsonl: line 1: expected numbers as success and return"),
        ("back", "progress.jsonl: line 2: expected seconds and steps that do not fall"),
        ("twice", "seed: expected another than 0, that of "),
        ("mixed", "name: expected a name of its own: its configuration or its map is not that of "),
        ("map", "name: expected a name of its own: "),
        ("apart", "curves: imagined: expected seeds that are known over the same minutes"),
    ],
)
def test_unusable_folders_are_refused_in_one_line(vssm, tmp_path, what, said):
    folders = broken(tmp_path, what)
    code, printed, err = vssm("curves", *folders, "--out", tmp_path / "curves.svg")
    assert (code, printed, err.count("\n")) == (2, "", 1)
    assert said in err
    assert not (tmp_path / "curves.svg").exists()


def test_the_axis_of_minutes_ends_at_the_given_time(vssm, tmp_path):
    folder = run(tmp_path / "a", straight(300.0, 1100, 0.8))
    assert figure(grouped([read_training(folder)]), minutes=20.0).axes[0].get_xlim() == (0.0, 20.0)
    assert vssm("curves", folder, "--out", tmp_path / "curves.svg", "--minutes", 20)[0] == 0
    code, _, err = vssm("curves", folder, "--out", tmp_path / "none.svg", "--minutes", 0)
    assert (code, err.count("\n")) == (2, 1)
    assert "curves: minutes: expected more than 0; found 0" in err


@pytest.mark.parametrize(
    ("out", "said"),
    [
        ("curves.pdf", "file: expected a name that ends in .svg or .png"),
        ("none/curves.svg", "folder: expected a folder that exists"),
    ],
)
def test_unwritable_outputs_are_refused_before_anything_is_read(vssm, tmp_path, out, said):
    code, _, err = vssm("curves", tmp_path / "nowhere", "--out", tmp_path / out)
    assert (code, err.count("\n")) == (2, 1)
    assert said in err


def test_without_a_folder_nothing_is_drawn(vssm, tmp_path):
    code, _, err = vssm("curves", "--out", tmp_path / "curves.svg")
    assert code == 2
    assert "RUN" in err
    with pytest.raises(InputError, match="a folder of `vssm-gym train`"):
        grouped([])
