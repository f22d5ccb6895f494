"""Test logs of poses and controls: what readers return, how logs are cut, and what is refused by name."""

import gzip

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.helpers.dynamics.logs import circling, write_blackbird, write_euroc
from vssm_gym.data.dynamics.log import DynamicsLog, cut, measured_velocity
from vssm_gym.data.dynamics.read import read_dynamics
from vssm_gym.data.sequences import SequenceWriter, imu_line
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera


@pytest.fixture
def flight():
    return circling(seconds=4.0)


def test_a_blackbird_flight_is_read(flight, tmp_path):
    log = read_dynamics(write_blackbird(tmp_path / "a.hdf5", flight))
    assert log.kind == "imu"
    np.testing.assert_allclose(log.times, flight.times, atol=1e-6)
    np.testing.assert_allclose(log.T_world_body, flight.T_world_body, atol=1e-9)
    np.testing.assert_allclose(log.controls[:, :6], flight.controls, atol=1e-9)
    np.testing.assert_allclose(log.controls[:, 6], flight.controls[:, 2], atol=1e-9)


@pytest.mark.parametrize("packed", [False, True])
def test_a_euroc_flight_is_read(packed, flight, tmp_path):
    log = read_dynamics(write_euroc(tmp_path, flight, packed))
    np.testing.assert_allclose(log.times, flight.times, atol=1e-6)
    np.testing.assert_allclose(log.T_world_body, flight.T_world_body, atol=1e-6)
    np.testing.assert_allclose(log.controls, flight.controls, atol=1e-6)
    np.testing.assert_allclose(log.velocity[10:-10], flight.velocity[10:-10], atol=0.01)


def write_recording(folder, command):
    """Write ten images of a robot that drives along x with its camera 0.5 m above the floor."""
    T_body_cam = np.eye(4)
    T_body_cam[2, 3] = 0.5
    writer = SequenceWriter(folder, Camera.from_hfov(8, 6, 1.5), T_body_cam)
    for k in range(30):
        T = np.eye(4)
        T[:3, 3] = [0.1 * k, 0.0, 0.5]
        writer.append(0.2 * k, np.zeros((6, 8, 3), np.uint8), np.ones((6, 8)), T, np.array(command))
    writer.close()
    return folder


@pytest.mark.parametrize(("command", "kind"), [((0.0, 0.0, 0.1), "holonomic"), ((0.5, 0.0), "car")])
def test_a_recorded_drive_is_read(command, kind, tmp_path):
    log = read_dynamics(write_recording(tmp_path / "drive", command))
    assert log.kind == kind
    steps = cut(log)
    assert steps.dt == pytest.approx(0.2)
    assert len(steps) == 29
    np.testing.assert_allclose(steps.controls, np.tile(command, (29, 1)))
    np.testing.assert_allclose(steps.T_world_body[:, 2, 3], 0.0, atol=1e-9)  # the body stands on the floor
    np.testing.assert_allclose(steps.velocity[:, 0], 0.5, atol=1e-5)


def test_a_recorded_flight_has_the_readings_of_its_imu(tmp_path):
    folder = write_recording(tmp_path / "flight", (0.0, 0.0, 9.81, 0.0, 0.0, 0.0))
    readings = "".join(imu_line(0.05 * k, np.array([0.1, 0.2, 0.3, 0.0, 0.0, 9.81])) for k in range(1, 117))
    (folder / "imu.txt").write_text(readings)
    log = read_dynamics(folder)
    assert log.kind == "imu"
    np.testing.assert_allclose(log.controls[0], [0.0, 0.0, 9.81, 0.1, 0.2, 0.3])


def test_steps_hold_the_mean_of_their_readings(flight):
    """A step of ten readings, by hand; poses are those at its ends."""
    steps = cut(flight, 0.1)
    assert steps.dt == 0.1
    np.testing.assert_allclose(steps.controls[3], flight.controls[30:40].mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(steps.T_world_body[3], flight.T_world_body[30], atol=1e-9)
    later = cut(flight, 0.1, 0.04)
    np.testing.assert_allclose(later.controls[3], flight.controls[34:44].mean(axis=0), atol=1e-9)
    assert len(steps.part(3, 10)) == 7
    np.testing.assert_array_equal(steps.part(3, 10).T_world_body[0], steps.T_world_body[3])


def test_velocities_are_those_of_the_motion(flight):
    velocity = measured_velocity(flight.times, flight.T_world_body)
    np.testing.assert_allclose(velocity[15:-15], flight.velocity[15:-15], atol=2e-3)


def changed(flight: DynamicsLog, **fields):
    values = {name: getattr(flight, name) for name in ("times", "T_world_body", "control_times", "controls")}
    return DynamicsLog("a log", "imu", **(values | fields))


def test_what_is_no_log_is_refused(flight):
    with pytest.raises(InputError, match="ascend"):
        changed(flight, times=flight.times[::-1])
    with pytest.raises(InputError, match="at least"):
        changed(flight, times=flight.times[:5])
    bad = flight.controls.copy()
    bad[3, 2] = np.nan
    with pytest.raises(InputError, match=r"controls: .*finite"):
        changed(flight, controls=bad)
    late = flight.times + np.where(np.arange(len(flight.times)) > 200, 2.0, 0.0)
    with pytest.raises(InputError, match="gap"):
        cut(changed(flight, times=late, control_times=late), 0.1)
    with pytest.raises(InputError, match="steps"):
        cut(flight, 1.0)


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("thrust", lambda h: h.__delitem__("thrust")),
        ("gyro_calib", lambda h: (h.__delitem__("gyro_calib"), h.create_dataset("gyro_calib", data=np.zeros((5, 2))))),
        ("accel_calib", lambda h: h["accel_calib"].__setitem__((0, 0), np.nan)),
        ("traj_target", lambda h: h["traj_target"].__setitem__((slice(None), slice(3, 7)), 0.0)),
        ("rows", lambda h: (h.__delitem__("ts"), h.create_dataset("ts", data=np.arange(30.0)))),
    ],
)
def test_a_damaged_blackbird_flight_is_refused_by_field(field, change, flight, tmp_path):
    import h5py

    path = write_blackbird(tmp_path / "a.hdf5", flight)
    with h5py.File(path, "a") as stored:
        change(stored)
    with pytest.raises(InputError) as caught:
        read_dynamics(path)
    assert caught.value.field == field


def test_a_cut_blackbird_flight_is_refused(flight, tmp_path):
    path = write_blackbird(tmp_path / "a.hdf5", flight)
    whole = path.read_bytes()
    for share in (0.0, 0.02, 0.6):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError):
            read_dynamics(path)


@pytest.mark.parametrize("damage", ["word", "columns", "quaternion", "gzip", "missing"])
def test_a_damaged_euroc_flight_is_refused(damage, flight, tmp_path):
    folder = write_euroc(tmp_path, flight, packed=True)
    states = folder / "gt_openvins.csv.gz"
    text = gzip.decompress(states.read_bytes()).decode()
    first = text.splitlines()[1]
    damaged = {
        "word": text.replace(first, "nothing"),
        "columns": text.replace(first, first[:40]),
        "quaternion": text.replace(first, ",".join([*first.split(",")[:4], *"0000", *first.split(",")[8:]])),
    }
    if damage == "missing":
        states.unlink()
    else:
        states.write_bytes(gzip.compress(damaged[damage].encode()) if damage in damaged else states.read_bytes()[:60])
    with pytest.raises(InputError) as caught:
        read_dynamics(folder)
    assert str(folder) in str(caught.value)


def test_another_file_is_refused(tmp_path):
    (tmp_path / "a.txt").write_text("1 2 3\n")
    for path in (tmp_path / "a.txt", tmp_path / "none"):
        with pytest.raises(InputError, match="Blackbird"):
            read_dynamics(path)
    with pytest.raises(InputError, match="this is another folder"):
        read_dynamics(tmp_path)


def test_the_flights_beside_the_checkout_are_read(shared_data):
    """Real data: the mean rate of the gyroscope is that of the poses."""
    for name in ("blackbird_clover/train.hdf5", "euroc_V1_01_easy"):
        steps = cut(read_dynamics(shared_data / "uav_imu" / name), 0.1)
        R = Rotation.from_matrix(steps.T_world_body[:, :3, :3])
        turned = (R[:-1].inv() * R[1:]).as_rotvec() / steps.dt
        off = turned - steps.controls[:, 3:6]
        assert (off - off.mean(axis=0)).std() < 0.1, name
