"""Test the fit of a robot's odometry: it finds known noise behind noisy poses, and refuses what it cannot read."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.errors import InputError
from vssm_gym.model.transition.calibrated import CalibratedDrive
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.model.transition.odometry import Odometry
from vssm_gym.training.dynamics.odometry_fit import Drives, fit_errors, fit_odometry, log_likelihood, windows_of

FLOOR, SHARE = (0.002, 0.001, 0.01), (0.1, 0.05, 0.1)
GAINS = np.array([1.1, 1.1, 0.93])
ERRORS = (0.003, 0.006)  # m, rad


def simulated(seed: int, drives: int, steps: int = 25) -> Drives:
    """Drive by known noise, and measure every pose with known errors."""
    by_start, by_motion, by_path, by_error = jax.random.split(jax.random.key(seed), 4)
    robot = CalibratedDrive(Odometry(FLOOR, SHARE), jnp.diag(jnp.asarray(GAINS)), jnp.zeros(3))
    low, high = jnp.array([0.0, 0.0, -0.4]), jnp.array([0.08, 0.0, 0.4])
    motions = jax.random.uniform(by_motion, (drives, steps, 3), minval=low, maxval=high)
    start = jax.random.uniform(by_start, (drives, 3), minval=-1.0, maxval=1.0)

    def drive(z, now):  # type: ignore[no-untyped-def]
        z = robot.sample(now[1], z, now[0], 0.0)
        return z, z

    _, path = jax.lax.scan(drive, start, (motions.swapaxes(0, 1), jax.random.split(by_path, steps)))
    poses = jnp.concatenate([start[:, None], path.swapaxes(0, 1)], axis=1)
    stds = jnp.array([ERRORS[0], ERRORS[0], ERRORS[1]])
    return Drives(motions, PLANAR.perturb(poses, stds * jax.random.normal(by_error, poses.shape)))


@pytest.mark.slow
def test_known_noise_is_found_behind_noisy_poses() -> None:
    found = fit_odometry(simulated(0, 200))
    drive = found.transition.drive
    np.testing.assert_allclose(np.diag(found.transition.gain), GAINS, atol=0.01)
    np.testing.assert_allclose(found.errors, ERRORS, rtol=0.1)
    # Floor and share of one coordinate stand for each other: what they say of usual motions is compared
    for moved, at in ((0.04, 0), (0.04, 1), (0.2, 2)):
        wanted, got = (law.floor[at] + law.share[at] * moved * GAINS[at] for law in (Odometry(FLOOR, SHARE), drive))
        assert got == pytest.approx(wanted, rel=0.2), at
    held = simulated(1, 50)
    plain = Odometry((0.02, 0.02, 0.05), (0.1, 0.1, 0.1))
    assert log_likelihood(found.transition, found.errors, held) > 0.5 + log_likelihood(plain, ERRORS, held)


def test_the_likelihood_of_one_step_is_the_gaussian_of_the_difference() -> None:
    """Two poses measured with errors, between them one step that does not turn: variances add up."""
    drives = Drives(jnp.zeros((1, 1, 3)), jnp.array([[[0.0, 0.0, 0.0], [0.004, -0.003, 0.01]]]))
    found = log_likelihood(Odometry((0.003, 0.003, 0.02), (0.0, 0.0, 0.0)), (0.002, 0.01), drives)
    variance = np.array([0.003, 0.003, 0.02]) ** 2 + 2.0 * np.array([0.002, 0.002, 0.01]) ** 2
    xi = np.asarray(PLANAR.error(drives.poses[0, 0], drives.poses[0, 1]))
    wanted = -0.5 * np.sum(xi**2 / variance + np.log(2.0 * np.pi * variance))
    assert float(found) == pytest.approx(wanted, rel=1e-4)


@pytest.mark.slow
def test_few_updates_already_raise_the_likelihood() -> None:
    drives = simulated(2, 16, steps=5)
    short, long = (fit_odometry(drives, updates).log_likelihood for updates in (1, 30))
    assert long > short
    transition = Odometry(FLOOR, SHARE)
    errors = fit_errors(transition, drives, 30)
    assert log_likelihood(transition, errors, drives) > log_likelihood(transition, (0.05, 0.05), drives)


def test_windows_follow_the_drives() -> None:
    motions, poses = np.arange(33.0).reshape(11, 3), np.arange(36.0).reshape(12, 3)
    cut = windows_of([motions, motions], [poses, poses], steps=5)
    assert cut.motions.shape == (4, 5, 3) and cut.poses.shape == (4, 6, 3)
    np.testing.assert_array_equal(cut.motions[1], motions[5:10])
    np.testing.assert_array_equal(cut.poses[1], poses[5:11])


@pytest.mark.parametrize(
    ("motions", "poses", "field"),
    [
        (np.zeros((30, 3)), np.zeros((30, 3)), "poses"),
        (np.zeros((30, 2)), np.zeros((31, 3)), "poses"),
        (np.zeros((30, 3)), np.full((31, 3), np.nan), "poses"),
        (np.zeros((10, 3)), np.zeros((11, 3)), "motions"),
    ],
)
def test_drives_that_cannot_be_read_are_named(motions: np.ndarray, poses: np.ndarray, field: str) -> None:
    with pytest.raises(InputError) as error:
        windows_of([motions], [poses])
    assert error.value.field == field
