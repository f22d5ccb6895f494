"""Test that a robot which turns in place sees by its colours how it has turned, and does not imagine that it sees."""

import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.envs.rendering.raycast import RaycastCamera
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import planar_to_matrix
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.tracking import standing_views, visual_turn
from vssm_gym.inference.tracking.error_covariance import ERRORS, Considered, nothing
from vssm_gym.model.emission import RGBD
from vssm_gym.model.transition import GaussianBelief, planar_belief

CAMERA = Camera.from_hfov(160, 120, 0.5 * np.pi)
ROBOT = HolonomicRobot()
RIG = Rig.of(CAMERA, ROBOT.T_body_cam)
ALONE = nothing(3)  # errors that have nothing in common with the map's
COMMANDED, NOISE = 0.2, 0.105  # rad: a full turn at noise "mid"
KNOWN = 0.01  # rad, of the headings of the kept views
UNSEEN = 2.0 * NOISE  # rad, after four turns that no image showed
PLACES = [(2.0, 1.0), (4.0, 3.0), (6.3, 5.0), (3.2, 5.1), (1.2, 4.2)]  # m, in reed


@pytest.fixture(scope="module")
def camera():
    found = RaycastCamera(load_scene("reed").boxes(), CAMERA)
    yield found
    found.close()


def grey(camera: RaycastCamera, planar: np.ndarray, gain: float = 1.0) -> jnp.ndarray:
    """Return the small luminance of the view from a pose, without any depth."""
    rgb, depth = camera.render(planar_to_matrix(planar) @ ROBOT.T_body_cam)
    rgb = np.clip(gain * rgb.astype(float), 0.0, 255.0).astype(np.uint8)
    return visual_turn.small_grey(RGBD.from_camera(rgb, np.zeros_like(depth)), CAMERA)


def beliefs(planar: np.ndarray, driven: float = 0.0) -> tuple[GaussianBelief, GaussianBelief]:
    """Return the beliefs before and, as predicted, after a commanded turn."""
    ahead = driven * np.array([np.cos(planar[2]), np.sin(planar[2]), 0.0])
    before = planar_belief(jnp.asarray(planar, jnp.float32), 1e-4 * jnp.eye(3))
    after = jnp.asarray(planar + ahead + np.array([0.0, 0.0, COMMANDED]), jnp.float32)
    return before, planar_belief(after, jnp.diag(jnp.array([1e-4, 1e-4, 1e-4 + NOISE**2])))


def test_the_turn_is_seen_to_half_a_degree_whatever_the_exposure(camera):
    rng, errors, told = np.random.default_rng(0), [], []
    for place in PLACES:
        for _ in range(6):
            planar = np.array([*place, rng.uniform(-np.pi, np.pi)])
            turned = float(np.clip(rng.normal(COMMANDED, NOISE), 0.0, 0.6))
            before, predicted = beliefs(planar)
            images = grey(camera, planar), grey(camera, planar + np.array([0, 0, turned]), gain=rng.uniform(0.85, 1.1))
            belief, sees = visual_turn.turned(predicted, before, *images, RIG, ALONE)
            told.append(bool(sees))
            if sees:
                errors.append(float(belief.mean[2]) - planar[2] - turned)
                # The turn's noise is gone but for the images' own; the heading before is as uncertain as it was.
                assert float(belief.covariance[2, 2]) == pytest.approx(1e-4 + visual_turn.STD**2, rel=0.02)
                np.testing.assert_allclose(belief.mean[:2], planar[:2], atol=1e-5)
            else:
                np.testing.assert_allclose(belief.mean, predicted.mean, atol=1e-6)
                np.testing.assert_allclose(belief.covariance, predicted.covariance, atol=1e-9)
    assert np.mean(told) > 0.8
    wrapped = (np.array(errors) + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(wrapped).max() < 4.0 * visual_turn.STD


def test_a_correction_is_the_products_of_two_gaussians(camera):
    """The mean moves by q / (q + s^2) of what the images show."""
    planar = np.array([*PLACES[0], 0.7])
    before, predicted = beliefs(planar)
    images = grey(camera, planar), grey(camera, planar + np.array([0, 0, COMMANDED + 0.1]))
    belief, sees = visual_turn.turned(predicted, before, *images, RIG, ALONE)
    assert sees
    share = NOISE**2 / (NOISE**2 + visual_turn.STD**2)
    assert float(belief.mean[2]) - planar[2] - COMMANDED == pytest.approx(0.1 * share, abs=0.008)


@pytest.mark.parametrize("correlation", [0.0, 0.7, -0.99])
def test_a_corrected_covariance_is_one_however_errors_are_correlated(camera, correlation):
    """Only what is independent of the place can be taken from the heading's variance."""
    planar = np.array([*PLACES[0], 0.7])
    before, predicted = beliefs(planar)
    shared = correlation * 0.01 * float(jnp.sqrt(predicted.covariance[2, 2]))
    P = predicted.covariance.at[0, 2].set(shared).at[2, 0].set(shared)
    images = grey(camera, planar), grey(camera, planar + np.array([0, 0, COMMANDED]))
    belief, sees = visual_turn.turned(planar_belief(predicted.mean, P), before, *images, RIG, ALONE)
    assert sees
    corrected = np.asarray(belief.covariance, float)
    assert np.linalg.eigvalsh(corrected)[0] > 0.0
    assert corrected[2, 2] < float(P[2, 2])
    if correlation == 0.0:
        assert corrected[2, 2] == pytest.approx(1e-4 + visual_turn.STD**2, rel=0.02)


@pytest.mark.parametrize("shared", ["with the map", "with the surfaces"])
def test_what_a_heading_has_in_common_with_the_map_cannot_be_taken_from_it(camera, shared):
    """The belief before is surer of its heading than its correlation with the errors of the map admits."""
    planar, rng = np.array([*PLACES[0], 0.7]), np.random.default_rng(0)
    before, predicted = beliefs(planar)
    frames = 1e-3 * np.cov(rng.normal(size=(12, 40)))
    cross = 0.02 * np.linalg.cholesky(frames) @ rng.normal(size=12) if shared == "with the map" else np.zeros(12)
    direction = rng.normal(size=ERRORS)
    surfaces = 0.08 * direction / np.linalg.norm(direction) if shared == "with the surfaces" else np.zeros(ERRORS)
    none = nothing(3)
    considered = Considered(
        jnp.asarray(frames, jnp.float32),
        none.frames_state.at[:, 2].set(cross),
        none.state_surfaces.at[2].set(surfaces),
        none.frames_surfaces,
    )
    images = grey(camera, planar), grey(camera, planar + np.array([0, 0, COMMANDED]))
    belief, sees = visual_turn.turned(predicted, before, *images, RIG, considered)
    assert sees
    assert np.linalg.eigvalsh(np.asarray(considered.joint(predicted.covariance), float))[0] >= 0.0
    assert np.linalg.eigvalsh(np.asarray(considered.joint(belief.covariance), float))[0] >= 0.0
    assert 2e-4 < float(belief.covariance[2, 2]) < float(predicted.covariance[2, 2])


@pytest.mark.parametrize("level", [0.0, 0.5])
def test_images_without_contrast_tell_nothing(level):
    before, predicted = beliefs(np.zeros(3))
    flat = jnp.full((60, 80), level)
    assert not visual_turn.turned(predicted, before, flat, flat, RIG, ALONE)[1]


def test_images_of_two_places_tell_nothing(camera):
    """A robot that was carried off has not turned."""
    told = []
    for a, b in zip(PLACES, PLACES[1:] + PLACES[:1], strict=True):
        planar = np.array([*a, 0.3])
        before, predicted = beliefs(planar)
        images = grey(camera, planar), grey(camera, np.array([*b, 2.0]))
        told.append(bool(visual_turn.turned(predicted, before, *images, RIG, ALONE)[1]))
    assert not any(told)


def test_a_robot_that_drove_is_not_corrected(camera):
    planar = np.array([*PLACES[0], 0.7])
    before, predicted = beliefs(planar, driven=0.1)
    images = grey(camera, planar), grey(camera, planar + np.array([0, 0, COMMANDED]))
    assert not visual_turn.turned(predicted, before, *images, RIG, ALONE)[1]


def turned_belief(planar: np.ndarray, std: float) -> GaussianBelief:
    """Return the belief of a robot that knows where it stands, and its heading to ``std`` rad."""
    return planar_belief(jnp.asarray(planar, jnp.float32), jnp.diag(jnp.array([1e-6, 1e-6, std**2])))


def looked_around(camera, place, headings) -> standing_views.StandingViews:
    """Return the views of a robot that has seen its turns at a place."""
    poses = [np.array([*place, heading]) for heading in headings]
    views = standing_views.begin(turned_belief(poses[0], KNOWN), grey(camera, poses[0]))
    for pose in poses[1:]:
        views = standing_views.remember(views, turned_belief(pose, KNOWN), grey(camera, pose))
    return views


@pytest.mark.parametrize("place", PLACES)
def test_a_heading_is_found_again(camera, place):
    views = looked_around(camera, place, np.arange(-3.0, 3.1, 0.2))
    rng, told, errors = np.random.default_rng(0), [], []
    for heading in rng.uniform(-3.0, 3.0, 6):
        believed = heading + float(np.clip(rng.normal(0.0, UNSEEN), -2 * UNSEEN, 2 * UNSEEN))
        image = grey(camera, np.array([*place, heading]), gain=rng.uniform(0.85, 1.1))
        found, sees = standing_views.recognised(
            turned_belief(np.array([*place, believed]), UNSEEN), views, image, RIG, ALONE
        )
        told.append(bool(sees))
        if sees:
            errors.append(float(found.mean[2]) - heading)
            assert float(found.covariance[2, 2]) == pytest.approx(KNOWN**2 + visual_turn.STD**2, rel=0.05)
    assert np.mean(told) >= 0.5
    wrapped = (np.array(errors) + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(wrapped).max() < 4.0 * visual_turn.STD


def test_what_was_seen_from_another_place_tells_nothing(camera):
    views = looked_around(camera, PLACES[0], np.arange(-3.0, 3.1, 0.2))
    for other in PLACES[1:]:
        image = grey(camera, np.array([*other, 0.3]))
        told = standing_views.recognised(turned_belief(np.array([*PLACES[0], 0.3]), UNSEEN), views, image, RIG, ALONE)[
            1
        ]
        assert not told


def test_views_are_kept_apart_and_forgotten_where_the_robot_has_driven(camera):
    x, y = PLACES[0]
    views = looked_around(camera, (x, y), [0.0, 0.05, 0.2, 0.25, 0.4])
    assert int(views.count) == 3
    np.testing.assert_allclose(views.mean[:3, 2], [0.0, 0.2, 0.4], atol=1e-6)
    there = np.array([x + 0.16, y, 0.4])
    views = standing_views.remember(views, turned_belief(there, KNOWN), grey(camera, there))
    assert int(views.count) == 1
    np.testing.assert_allclose(views.mean[0], there, atol=1e-6)


def test_the_oldest_view_is_replaced(camera):
    views = looked_around(camera, PLACES[0], np.linspace(-np.pi, np.pi, 36, endpoint=False))
    assert int(views.count) == 36
    np.testing.assert_allclose(views.mean[3, 2], -np.pi + 35 * 2 * np.pi / 36, atol=1e-5)
