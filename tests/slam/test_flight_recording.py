"""Test the recording of a flight, ``slam`` on it, and the study of it."""

import json
import shutil

import numpy as np
import pytest

from tests.helpers.flight_hall import hall
from vssm_gym.cli.record import record
from vssm_gym.data.flights import FLIGHT_DEPTH_SCALE, record_flight
from vssm_gym.data.recording import read_provenance
from vssm_gym.data.sequences import FrameReader, load_sequence
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError
from vssm_gym.eval.studies import flight as study_flight
from vssm_gym.geometry.gravity import GRAVITY
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.run import run_slam

SMALL = CameraConfig(64, 48)
FAR = {"size": (64, 48), "rate": 20.0, "voxel": 0.25, "extent": 16.0, "max_depth": 20.0, "depth": "stereo"}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    save_scene(hall(), folder / "hall.json")
    heard = []
    frames = record_flight(
        folder / "hall.json",
        folder / "figure8",
        flight="figure8",
        speed=4.0,
        camera=SMALL,
        seed=1,
        on_progress=lambda *event: heard.append(event),
    )
    assert heard[-1] == ("recording", frames, frames)
    return folder / "figure8"


def test_a_recorded_flight_is_a_closed_path_with_commands_and_imu(recording):
    sequence = load_sequence(recording)
    assert sequence.notices == ()
    assert sequence.depth_scale == FLIGHT_DEPTH_SCALE
    poses = sequence.true_poses()
    assert np.linalg.norm(poses[0, :3, 3] - poses[-1, :3, 3]) < 0.3
    assert sequence.controls.shape == (len(sequence.frames), 7)
    made = read_provenance(recording)
    assert (made["motion"], made["flight"], made["speed"], made["seed"]) == ("flight", "figure8", 4.0, 1)
    _, depth = FrameReader(sequence)[0]
    assert (depth > 0.0).all()


def test_a_flight_is_recorded_for_some_seconds_from_its_start(recording, tmp_path):
    frames = record_flight(
        recording.parent / "hall.json",
        tmp_path / "begun",
        flight="figure8",
        speed=4.0,
        seconds=0.5,
        camera=SMALL,
        seed=1,
    )
    begun, whole = load_sequence(tmp_path / "begun"), load_sequence(recording)
    assert frames == len(begun.frames) == 11
    np.testing.assert_array_equal(begun.true_poses(), whole.true_poses()[:11])
    assert read_provenance(tmp_path / "begun")["seconds"] == 0.5
    with pytest.raises(InputError, match="seconds"):
        record_flight(recording.parent / "hall.json", tmp_path / "none", seconds=0.0)


def test_the_recorded_imu_agrees_with_the_poses(recording):
    """Mean force and rate between two frames are those of the true poses, up to bias and noise."""
    sequence = load_sequence(recording)
    times, poses = sequence.times, sequence.true_poses()
    assert (np.diff(sequence.imu[:, 0]) > 0.0).all()
    k = len(times) // 3
    speeds = np.diff(poses[k - 5 : k + 6, :3, 3], axis=0) / 0.05
    acceleration = (speeds[-1] - speeds[0]) / 0.45
    inside = (sequence.imu[:, 0] > times[k - 5]) & (sequence.imu[:, 0] <= times[k + 5])
    R_world_body = poses[k, :3, :3] @ sequence.T_body_cam[:3, :3].T
    force = R_world_body @ sequence.imu[inside, 4:].mean(axis=0)
    np.testing.assert_allclose(force, acceleration - GRAVITY, atol=0.9)  # biases of 0.2 m/s^2; the body turned
    assert np.abs(force - acceleration).max() > 9.0  # gravity is in there


@pytest.mark.slow
@pytest.mark.parametrize("imu", [False, True])
def test_slam_follows_a_flight(recording, imu):
    sequence = load_sequence(recording)
    run = run_slam(sequence, SlamOptions(imu=imu, **FAR))
    row = study_flight.measured(run, sequence.true_poses())
    assert row["lost"] == 0
    assert row["ate_m"] < 0.3  # cells of 25 cm, images of 64 pixels
    assert row["length_m"] > 20.0


def test_a_missing_imu_file_is_refused(recording, tmp_path):
    shutil.copytree(recording, tmp_path / "blind")
    (tmp_path / "blind" / "imu.txt").unlink()
    with pytest.raises(InputError, match=r"imu\.txt"):
        run_slam(load_sequence(tmp_path / "blind"), SlamOptions(imu=True, **FAR))
    for text in ("0 1 2 3\n", "0 0 0 0 0 0 nan\n", "1 0 0 0 0 0 0\n0 0 0 0 0 0 0\n", "a b c d e f g\n"):
        (tmp_path / "blind" / "imu.txt").write_text(text)
        with pytest.raises(InputError, match=r"imu\.txt"):
            load_sequence(tmp_path / "blind")


@pytest.mark.slow
def test_the_study_states_its_measurements(tmp_path):
    heard = []
    options = SlamOptions(**FAR)
    study = study_flight.run(
        hall(),
        flights=("figure8",),
        speeds=(4.0,),
        sensor_noise="none",
        options=options,
        on_progress=lambda *e: heard.append(e),
    )
    (row,) = study.figures["rows"]
    assert len(study.lines[0]) == len(study.header)
    assert row["lost"] == 0 and 0.0 < row["ate_m"] < 0.3
    assert {event[0] for event in heard} == {"figure8 4 m/s: recording", "figure8 4 m/s: tracking"}
    assert f"{int(row['ate_m'] <= 0.1)} of 1 flights within 10 cm" in study.answer
    json.dumps(study.figures, allow_nan=False)
    with pytest.raises(InputError, match="flights"):
        study_flight.run(hall(), flights=("loop",), speeds=(1.0,), sensor_noise="none", options=options)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [({"speed": 2.0}, "speed"), ({"flight": "star"}, "flight"), ({"motion": "flight", "metres": 3.0}, "metres")],
)
def test_options_of_another_motion_are_refused(tmp_path, keywords, message):
    with pytest.raises(InputError, match=message):
        record("oak", tmp_path / "new", **keywords)
