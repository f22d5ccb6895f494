"""Test trajectories on disk: round trip in both formats, interpolation, clear errors for bad files."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vssm_gym.data import trajectories
from vssm_gym.data.trajectories import interpolate, read_trajectory, tum_line, velocities, write_trajectory
from vssm_gym.errors import InputError


def poses(rng: np.random.Generator, n: int) -> np.ndarray:
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.random(n, rng=rng).as_matrix()
    T[:, :3, 3] = rng.uniform(-30.0, 30.0, (n, 3))
    return T


def rotation_between(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the angle (rad) between rotations (..., 3, 3)."""
    return Rotation.from_matrix(np.swapaxes(A, -1, -2) @ B).magnitude()


@given(st.integers(0, 2**32 - 1), st.integers(1, 20))
def test_tum_round_trip(tmp_path_factory, seed: int, n: int) -> None:
    rng, path = np.random.default_rng(seed), tmp_path_factory.mktemp("trajectory") / "trajectory.txt"
    times, T = np.cumsum(rng.uniform(0.01, 0.2, n)) + 1.3e9, poses(rng, n)
    write_trajectory(path, times, T)
    read_times, read = read_trajectory(path)
    np.testing.assert_allclose(read_times, times, atol=1e-6)
    np.testing.assert_allclose(read[:, :3, 3], T[:, :3, 3], atol=1e-7)
    assert rotation_between(read[:, :3, :3], T[:, :3, :3]).max() < 1e-6
    np.testing.assert_array_equal(read[:, 3], np.tile([0, 0, 0, 1], (n, 1)))
    assert [p.name for p in path.parent.iterdir()] == ["trajectory.txt"]


def test_a_tum_line_by_hand() -> None:
    """A quarter turn about z: quaternion (x, y, z, w) = (0, 0, sqrt(1/2), sqrt(1/2))."""
    T = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    assert tum_line(1.5, T) == "1.500000 1.0000000 2.0000000 3.0000000 0.0000000 0.0000000 0.7071068 0.7071068\n"


def test_euroc_csv_by_hand(tmp_path: Path) -> None:
    """Nanoseconds, and the quaternion's w first; further columns are left alone."""
    path = tmp_path / "data.csv"
    path.write_text(
        "#timestamp, p, q_wxyz, v\n2000000000,1,2,3,0.70710678,0,0,0.70710678,9,9,9\n1000000000,0,0,0,1,0,0,0\n"
    )
    times, T = read_trajectory(path)
    np.testing.assert_allclose(times, [1.0, 2.0])  # sorted
    np.testing.assert_allclose(T[1], [[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-7)


def test_comments_blank_lines_and_unnormalised_quaternions(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("# time x y z qx qy qz qw\n\n 0.5 1 2 3 0 0 2 2 \n")
    times, T = read_trajectory(path)
    np.testing.assert_allclose(times, [0.5])
    np.testing.assert_allclose(T[0, :2, :2], [[0, -1], [1, 0]], atol=1e-12)


GOOD = "0 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("content", "field"),
    [
        (GOOD + "1 0 0 0 0 0 0\n", "line 2"),
        (GOOD + "\n1 0 x 0 0 0 0 1\n", "line 3"),
        (GOOD + "1 0 nan 0 0 0 0 1\n", "line 2"),
        (GOOD + "1 0 inf 0 0 0 0 1\n", "line 2"),
        (GOOD + "1 0 0 0 0 0 0 0\n", "quaternion"),
        ("", "file"),
        ("# only a comment\n", "file"),
    ],
)
def test_malformed_trajectories(tmp_path: Path, content: str, field: str) -> None:
    path = tmp_path / "t.txt"
    path.write_text(content)
    with pytest.raises(InputError) as caught:
        read_trajectory(path)
    assert (caught.value.source, caught.value.field) == (str(path), field)


def test_files_that_are_no_text(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_bytes(bytes(range(128, 256)) * 3)
    for bad in (path, tmp_path / "none.txt", tmp_path):
        with pytest.raises(InputError) as caught:
            read_trajectory(bad)
        assert caught.value.source == str(bad)


def test_lines_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "t.txt"
    path.write_text("0 0 0 0 0 0 0 1\n" * 3)
    assert len(read_trajectory(path)[0]) == 3
    path.write_text("\n" * 4)
    monkeypatch.setattr(trajectories, "TRAJECTORY_LINES", 3)
    with pytest.raises(InputError, match="lines: expected at most 3"):
        read_trajectory(path)


@given(st.integers(0, 2**32 - 1))
def test_interpolation_passes_through_its_nodes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times, T = np.cumsum(rng.uniform(0.05, 0.5, 6)), poses(rng, 6)
    np.testing.assert_allclose(interpolate(times, T, times), T, atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0))
def test_interpolation_is_linear_and_geodesic(seed: int, share: float) -> None:
    """At a fraction of the interval, distance and angle from both ends have that fraction and the rest."""
    times, T = np.array([2.0, 4.0]), poses(np.random.default_rng(seed), 2)
    (between,) = interpolate(times, T, np.array([2.0 + 2.0 * share]))
    np.testing.assert_allclose(between[:3, 3], (1 - share) * T[0, :3, 3] + share * T[1, :3, 3], atol=1e-9)
    angle = rotation_between(T[0, :3, :3], T[1, :3, :3])
    assert rotation_between(T[0, :3, :3], between[:3, :3]) == pytest.approx(share * angle, abs=1e-6)
    assert rotation_between(between[:3, :3], T[1, :3, :3]) == pytest.approx((1 - share) * angle, abs=1e-6)


def test_interpolation_is_clamped_to_the_ends() -> None:
    times, T = np.array([1.0, 2.0]), poses(np.random.default_rng(0), 2)
    np.testing.assert_allclose(interpolate(times, T, np.array([-5.0, 7.0])), T, atol=1e-12)
    np.testing.assert_allclose(interpolate(times[:1], T[:1], np.array([0.0, 9.0])), np.stack([T[0], T[0]]))


def test_repeated_stamps_interpolate_to_the_first(tmp_path: Path) -> None:
    """Motion capture sometimes stamps two poses alike; that is no reason to fail."""
    path = tmp_path / "t.txt"
    path.write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n1 5 0 0 0 0 0 1\n2 2 0 0 0 0 0 1\n")
    times, T = read_trajectory(path)
    between = interpolate(times, T, np.array([0.5, 1.0, 1.5]))
    np.testing.assert_allclose(between[:, 0, 3], [0.5, 1.0, 1.5])


def test_a_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    path, T = tmp_path / "t.txt", poses(np.random.default_rng(0), 2)
    write_trajectory(path, np.array([0.0, 1.0]), T)
    before = path.read_text()
    no_rotation = T * np.array([1.0, 0.0])[:, None, None]
    with pytest.raises(ValueError, match="determinant"):
        write_trajectory(path, np.array([0.0, 1.0]), no_rotation)
    with pytest.raises(InputError, match=r"T_world_cam: expected \(3, 4, 4\) poses"):
        write_trajectory(path, np.array([0.0, 1.0, 2.0]), T)
    assert path.read_text() == before


@pytest.mark.parametrize(
    ("name", "count", "start"),
    [
        ("fr2_desk_groundtruth.txt", 20957, (-0.1357, -1.4217, 1.4764)),
        ("freiburg1_xyz-groundtruth.txt", 3000, (1.3563, 0.6305, 1.6380)),
        ("V102.txt", 807, (-0.06151, 0.04838, 0.17712)),
    ],
)
def test_published_trajectories_load(
    shared_data: Path, name: str, count: int, start: tuple[float, float, float]
) -> None:
    times, T = read_trajectory(shared_data / "trajectories" / name)
    assert len(times) == len(T) == count
    assert (np.diff(times) >= 0).all()
    np.testing.assert_allclose(T[0, :3, 3], start, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(T[:, :3, :3]), 1.0, atol=1e-9)


@given(st.integers(0, 2**32 - 1))
def test_velocities_integrate_to_the_next_pose(seed: int) -> None:
    """World frame, as the rigid body's transition integrates them: ``t' = t + v dt``, ``R' = exp(w dt) R``."""
    rng = np.random.default_rng(seed)
    T, times = poses(rng, 10), np.cumsum(rng.uniform(0.05, 0.3, 10))
    v, w = np.split(velocities(times, T), 2, axis=1)
    dt = np.diff(times)[:, None]
    np.testing.assert_allclose(T[:-1, :3, 3] + v * dt, T[1:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(Rotation.from_rotvec(w * dt).as_matrix() @ T[:-1, :3, :3], T[1:, :3, :3], atol=1e-9)
