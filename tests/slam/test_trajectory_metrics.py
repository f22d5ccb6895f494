"""Test ATE and RPE against published reference values, evo, and the laws that they obey."""

import json
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from scipy.spatial.transform import Rotation

from vssm_gym.errors import InputError
from vssm_gym.slam import trajectory_error

TRUTH = {
    "fr2_desk_ORB": "fr2_desk_groundtruth.txt",
    "fr2_desk_ORB_kf_mono": "fr2_desk_groundtruth.txt",
    "freiburg1_xyz-rgbdslam": "freiburg1_xyz-groundtruth.txt",
    "V102": "V102_groundtruth.csv",
}


def random_poses(rng: np.random.Generator, n: int) -> np.ndarray:
    """Draw a smooth random walk on SE(3)."""
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, 3] = np.cumsum(rng.normal(0.0, 0.1, (n, 3)), axis=0)
    R = Rotation.identity()
    for i in range(n):
        R = R * Rotation.from_rotvec(rng.normal(0.0, 0.1, 3))
        T[i, :3, :3] = R.as_matrix()
    return T


def random_motion(rng: np.random.Generator) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.normal(0.0, 5.0, 3)
    return T


@pytest.mark.parametrize("name", sorted(TRUTH))
def test_reproduces_reference_values(name: str, shared_data: Path) -> None:
    from vssm_gym.data.sequences import read_trajectory

    folder = shared_data / "trajectories"
    reference = json.loads((folder / "reference_values.json").read_text())["results"][name]
    times_est, T_est = read_trajectory(folder / f"{name}.txt")
    times_true, T_true = read_trajectory(folder / TRUTH[name])
    result = trajectory_error.evaluate(times_est, T_est, times_true, T_true, tolerance=reference["assoc_max_diff_s"])
    assert result["pairs"] == reference["n_pairs"]
    ours_of_theirs = {
        "ape_trans_se3": "ate_translation_se3",
        "ape_rotdeg_se3": "ate_rotation_se3",
        "ape_trans_sim3": "ate_translation_sim3",
        "rpe_trans_1frame": "rpe_translation_1",
        "rpe_rotdeg_1frame": "rpe_rotation_1",
        "rpe_trans_30frames_allpairs": "rpe_translation_30",
        "rpe_rotdeg_30frames_allpairs": "rpe_rotation_30",
    }
    for theirs, ours in ours_of_theirs.items():
        for statistic, value in reference[theirs].items():
            assert result[ours][statistic] == pytest.approx(value, rel=1e-9, abs=1e-9), (theirs, statistic)


@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_evo(seed: int) -> None:
    pytest.importorskip("evo")
    from evo.core import metrics, sync
    from evo.core.trajectory import PoseTrajectory3D

    rng = np.random.default_rng(seed)
    T_true = random_poses(rng, 120)
    times_true = np.cumsum(rng.uniform(0.01, 0.05, 120))
    chosen = np.sort(rng.choice(120, 70, replace=False))
    T_est = random_motion(rng) @ T_true[chosen]
    T_est[:, :3, 3] += rng.normal(0.0, 0.02, (70, 3))
    times_est = times_true[chosen] + rng.normal(0.0, 0.005, 70)
    ref, est = sync.associate_trajectories(
        PoseTrajectory3D(poses_se3=list(T_true), timestamps=times_true),
        PoseTrajectory3D(poses_se3=list(T_est), timestamps=times_est),
        max_diff=0.01,
    )
    of_est, of_true = trajectory_error.associate(times_est, times_true, 0.01)
    assert np.array_equal(est.timestamps, times_est[of_est]) and np.array_equal(ref.timestamps, times_true[of_true])
    relative = metrics.RPE(metrics.PoseRelation.rotation_angle_deg, 7, metrics.Unit.frames, all_pairs=True)
    relative.process_data((ref, est))
    np.testing.assert_allclose(
        trajectory_error.rpe(T_est[of_est], T_true[of_true], 7).rotation, relative.error, atol=1e-9
    )
    est.align(ref, correct_scale=True)
    absolute = metrics.APE(metrics.PoseRelation.translation_part)
    absolute.process_data((ref, est))
    ours = trajectory_error.ate(T_est[of_est], T_true[of_true], "sim3").translation
    np.testing.assert_allclose(ours, absolute.error, atol=1e-9)


@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0.1, 10.0))
def test_alignment_recovers_the_motion(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    T_true, A = random_poses(rng, 20), random_motion(rng)
    T_est = A @ T_true
    assert trajectory_error.rpe(T_est, T_true, 3).translation.max() < 1e-9
    assert trajectory_error.ate(T_est, T_true).translation.max() < 1e-9
    assert trajectory_error.ate(T_est, T_true).rotation.max() < 1e-5
    T_est[:, :3, 3] *= scale
    found = trajectory_error.align(T_est[:, :3, 3], T_true[:, :3, 3], with_scale=True)
    assert found.scale == pytest.approx(1.0 / scale, rel=1e-9)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(found.apply(T_est), T_true, atol=1e-8)


@given(seed=st.integers(0, 2**32 - 1))
def test_errors_do_not_depend_on_the_estimates_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_true, T_est = random_poses(rng, 20), random_poses(rng, 20)
    moved = random_motion(rng) @ T_est
    for one, other in (
        (trajectory_error.ate(T_est, T_true), trajectory_error.ate(moved, T_true)),
        (trajectory_error.rpe(T_est, T_true, 3), trajectory_error.rpe(moved, T_true, 3)),
    ):
        np.testing.assert_allclose(one.translation, other.translation, atol=1e-9)
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-6)


@given(seed=st.integers(0, 2**32 - 1))
def test_alignment_is_optimal(seed: int) -> None:
    """No nearby rigid motion fits better, and a similarity never fits worse than a rigid motion."""
    rng = np.random.default_rng(seed)
    p_est, p_true = rng.normal(size=(2, 15, 3))
    T_est, T_true = np.tile(np.eye(4), (2, 15, 1, 1))
    T_est[:, :3, 3], T_true[:, :3, 3] = p_est, p_true
    best = np.sum(trajectory_error.ate(T_est, T_true).translation ** 2)
    assert np.sum(trajectory_error.ate(T_est, T_true, "sim3").translation ** 2) <= best + 1e-9
    found = trajectory_error.align(p_est, p_true)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)  # a rotation even where a reflection would fit better
    for _ in range(20):
        R = Rotation.from_rotvec(rng.normal(0.0, 0.05, 3)).as_matrix() @ found.rotation
        t = found.translation + rng.normal(0.0, 0.02, 3)
        assert np.sum((p_true - (p_est @ R.T + t)) ** 2) >= best - 1e-9


@given(
    short=st.lists(st.floats(0.0, 1.0), min_size=0, max_size=7),
    long=st.lists(st.floats(0.0, 1.0), min_size=8, max_size=20),
    tolerance=st.floats(0.0, 0.2),
)
def test_association_is_the_nearest_stamp(short: list[float], long: list[float], tolerance: float) -> None:
    a, b = np.array(short), np.array(long)
    of_a, of_b = trajectory_error.associate(a, b, tolerance)
    distance = np.abs(a[:, None] - b[None, :])
    assert list(of_a) == [i for i in range(len(a)) if distance[i].min() <= tolerance]
    np.testing.assert_array_equal(np.abs(a[of_a] - b[of_b]), distance[of_a].min(axis=1) if len(of_a) else [])
    back_b, back_a = trajectory_error.associate(b, a, tolerance)
    assert np.array_equal(back_a, of_a) and np.array_equal(back_b, of_b)


def test_angles_by_hand() -> None:
    """One case is a quarter turn of the last frame, the other a tiny turn that an arccos would round to zero."""
    for angle in (90.0, 180.0, 1e-7):
        T_true = np.tile(np.eye(4), (2, 1, 1))
        T_est = T_true.copy()
        T_est[1, :3, :3] = Rotation.from_euler("z", angle, degrees=True).as_matrix()
        T_est[1, 0, 3] = 0.25
        error = trajectory_error.rpe(T_est, T_true)
        assert error.rotation[0] == pytest.approx(angle, rel=1e-9) and error.translation[0] == 0.25


def test_bad_input_names_the_field() -> None:
    line = np.tile(np.eye(4), (5, 1, 1))
    line[:, 0, 3] = np.arange(5)
    with pytest.raises(InputError, match="do not lie on one line"):
        trajectory_error.ate(line, line)
    with pytest.raises(InputError, match="delta"):
        trajectory_error.rpe(line, line, 5)
    with pytest.raises(InputError, match="times"):
        trajectory_error.evaluate(np.arange(5.0), line, np.arange(5.0) + 100.0, line)


@given(seed=st.integers(0, 2**32 - 1))
def test_alignment_of_the_first_pose(seed: int) -> None:
    """It removes the error at the start for any frame; without alignment a wrong frame remains an error."""
    rng = np.random.default_rng(seed)
    T_true, A = random_poses(rng, 30), random_motion(rng)
    first = trajectory_error.ate(A @ T_true, T_true, "first")
    assert max(first.translation.max(), first.rotation.max()) < 1e-5
    drift = random_poses(rng, 30)
    one, other = (trajectory_error.ate(T, T_true, "first") for T in (T_true @ drift, A @ T_true @ drift))
    assert one.translation[0] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(one.translation, other.translation, atol=1e-9)
    # The best rigid motion never fits worse than the first pose's.
    assert np.sum(trajectory_error.ate(T_true @ drift, T_true).translation ** 2) <= np.sum(one.translation**2) + 1e-9
    unaligned = trajectory_error.ate(A @ T_true, T_true, "none").translation
    np.testing.assert_allclose(unaligned, np.linalg.norm((A @ T_true - T_true)[:, :3, 3], axis=1))


def test_straight_lines_have_errors_without_a_best_rotation() -> None:
    line = np.tile(np.eye(4), (5, 1, 1))
    line[:, 0, 3] = np.arange(5)
    result = trajectory_error.evaluate(np.arange(5.0), line, np.arange(5.0), line, alignments=("first", "none"))
    assert result["ate_translation_first"]["max"] == result["ate_translation_none"]["max"] == 0.0
    assert "scale" not in result
