"""Test ``vssm-gym slam2d``: a maze and a log from end to end, and clear errors."""

import json

import numpy as np
import pytest
import yaml
from PIL import Image

from vssm_gym.cli.slam2d import slam2d
from vssm_gym.data.laser_logs import write_laser_log
from vssm_gym.data.traversals import errors, traverse
from vssm_gym.envs.tasks.mazes import load_maze
from vssm_gym.errors import InputError

STEPS = 120


def test_a_maze_from_end_to_end(tmp_path, capsys):
    slam2d("pillars-v1", tmp_path / "out", steps=STEPS, seed=1)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"trajectory.txt", "map.yaml", "map.pgm", "slam2d.json", "slam2d.svg", "slam2d.html"} <= names
    poses = np.loadtxt(tmp_path / "out" / "trajectory.txt")
    about = yaml.safe_load((tmp_path / "out" / "map.yaml").read_text())
    image = np.asarray(Image.open(tmp_path / "out" / about["image"]))
    column, row = ((poses[:, :2] - about["origin"][:2]) / about["resolution"]).astype(int).T
    assert (image[image.shape[0] - 1 - row, column] == 254).all()  # where the robot was is free
    assert 0.05 < (image == 0).mean() < 0.5
    off = errors(traverse(load_maze("pillars-v1"), STEPS, 1), poses)
    figures = json.loads((tmp_path / "out" / "slam2d.json").read_text())["figures"]
    assert figures["PRISM in the plane"]["end"] == pytest.approx(off[-1], abs=1e-5)
    assert off.max() < 0.015 and figures["path integration"]["loops"] is None
    assert "At the end it is off by" in capsys.readouterr().out
    assert (
        "<svg" in (tmp_path / "out" / "slam2d.html").read_text()
        or "data:image/svg" in (tmp_path / "out" / "slam2d.html").read_text()
    )
    with pytest.raises(InputError, match="out"):
        slam2d("pillars-v1", tmp_path / "out", steps=STEPS)


@pytest.mark.slow
def test_a_log_is_judged_by_its_loops(tmp_path, capsys):
    log = traverse(load_maze("rooms-v1"), STEPS, seed=2)
    true = log.poses
    from vssm_gym.data.laser_logs import LaserLog
    from vssm_gym.geometry.planar_poses import relation

    pairs = np.array([[0, 60], [10, STEPS]])
    judged = LaserLog(
        log.ranges, log.angles, log.max_range, log.mount, log.motions, None, pairs,
        relation(true[pairs[:, 0]], true[pairs[:, 1]]),
    )  # fmt: skip
    write_laser_log(tmp_path / "drive.log", judged)
    slam2d(str(tmp_path / "drive.log"), tmp_path / "out", cell=0.01)
    figures = json.loads((tmp_path / "out" / "slam2d.json").read_text())["figures"]
    loops = figures["PRISM in the plane"]["loops"]
    assert loops["number"] == 2 and loops["mean"] < 0.01 < figures["path integration"]["loops"]["mean"]
    assert figures["path integration"]["end"] is None
    assert "Over 2 loops" in capsys.readouterr().out


def test_cells_that_are_too_coarse_are_said(tmp_path, capsys):
    slam2d("rooms-v1", tmp_path / "out", steps=60, cell=5.0)
    assert "It is worse than path integration: smaller cells" in capsys.readouterr().out
    setting = json.loads((tmp_path / "out" / "slam2d.json").read_text())["setting"]
    assert {"seed": 0, "noise": "low", "sensor_noise": "low", "steps": 60, "part": None}.items() <= setting.items()
    before = (tmp_path / "out" / "study.json").stat().st_mtime_ns
    with pytest.raises(InputError, match="out"):
        slam2d("rooms-v1", tmp_path / "out", steps=60)
    assert (tmp_path / "out" / "study.json").stat().st_mtime_ns == before  # a refused run writes nothing


@pytest.mark.slow
def test_a_latent_grid_beside_it(tmp_path):
    """A part of a drive, on line and in one more pass; the charts are drawn beside the occupancy."""
    slam2d("pillars-v1", tmp_path / "out", steps=STEPS, seed=1, scans="0:90", latent=True, passes=1)
    assert len(np.loadtxt(tmp_path / "out" / "trajectory_latent.txt")) == 90
    found = json.loads((tmp_path / "out" / "slam2d.json").read_text())["figures"]
    assert found["latent grid"]["end"] < 1.2 * found["path integration"]["end"] + 0.005
    assert len(found["latent grid"]["log_evidence"]) == 2


@pytest.mark.slow
def test_a_camera_in_the_place_of_the_scanner(tmp_path, capsys):
    slam2d("pillars-v1", tmp_path / "out", steps=STEPS, seed=1, sensor="camera", scans="10:110", passes=1)
    poses = np.loadtxt(tmp_path / "out" / "trajectory.txt")
    off = errors(traverse(load_maze("pillars-v1"), STEPS, 1, sensor="camera").part(10, 110), poses)
    figures = json.loads((tmp_path / "out" / "slam2d.json").read_text())["figures"]
    assert figures["latent grid"]["end"] == pytest.approx(off[-1], abs=1e-5)
    assert off[-1] < 1.2 * figures["path integration"]["end"] + 0.005
    assert "100 strips" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"log": "no.log"}, "file: expected a laser log"),
        ({"log": "roms-v1"}, "log: expected a file, or one of .*did you mean 'rooms-v1'"),
        ({"log": "pillars-v1", "cell": 0.0}, "cell: expected above 0 m"),
        ({"log": "pillars-v1", "steps": 0}, "steps"),
        ({"log": "pillars-v1", "passes": 1}, "passes: expected 0 without --latent"),
        ({"log": "pillars-v1", "steps": 9, "scans": "4:11"}, "scans: expected FIRST:LAST"),
        ({"log": "pillars-v1", "steps": 9, "scans": "all"}, "scans: expected FIRST:LAST"),
        ({"log": "pillars-v1", "noise": "loud", "steps": 5}, "noise"),
        ({"log": "drive.log", "sensor": "camera"}, "sensor: expected lidar for a file"),
        ({"log": "pillars-v1", "sensor": "camera", "baseline": True}, "sensor: expected lidar with --baseline"),
        ({"log": "pillars-v1", "sensor": "camera", "max_range": 1.0}, "sensor: expected lidar with --baseline"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, given, message):
    with pytest.raises(InputError, match=message):
        slam2d(out=tmp_path / "out", **given)
    assert not (tmp_path / "out" / "slam2d.html").exists()
