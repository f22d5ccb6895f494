"""Test map learning through the renderer: the gradient of log p, and the prediction of held-out views."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import fisk

from tests.helpers.analytic_room import camera_pose
from tests.helpers.localisation_room import CAMERA, GRID, ROOM
from vssm_gym.inference.mapping import map_learning, map_update
from vssm_gym.inference.mapping.map_learning import MapLearningConfig
from vssm_gym.inference.mapping.views import Views, fit_scales, held_out
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.emission import MAX_DEPTH, RGBD
from vssm_gym.model.emission_density import EmissionScales, log_prob

CONFIG = MapLearningConfig(images=2, pixels=256, steps=200, refresh=50)
SCALES = EmissionScales(depth=0.05, growth=0.0, rgb=0.05)


def make_views(count: int, seed: int, noise: float = 0.0) -> Views:
    """Take images of the room from its middle, all around."""
    rng = np.random.default_rng(seed)
    images, poses = [], []
    for yaw in np.linspace(0.0, 2.0 * np.pi, count, endpoint=False):
        T = camera_pose((*rng.uniform(-0.3, 0.3, 2), rng.uniform(0.5, 0.9)), yaw + rng.uniform(-0.2, 0.2), 0.1)
        image = ROOM.image(T, CAMERA)
        depth = np.array(image.depth) + noise * rng.standard_normal(image.depth.shape)
        images.append((np.rint(255 * np.asarray(image.rgb)).astype(np.uint8), depth))
        poses.append(T)
    return Views.stack(images, np.stack(poses), CAMERA)


def closed_form(views: Views) -> VoxelMap:
    m = VoxelMap.prior(*GRID)
    for i in range(len(views)):
        rgb = views.rgb[i].astype(jnp.float32) / 255.0
        m = map_update.update(m, views.depth[i], rgb, views.T_world_cam[i], CAMERA)
    return m


@functools.cache
def train() -> Views:
    return make_views(16, 0)


@functools.cache
def unseen() -> Views:
    return make_views(5, 1)


@functools.cache
def known_map() -> VoxelMap:
    return closed_form(train())


@pytest.fixture(scope="module")
def refined() -> tuple[VoxelMap, EmissionScales]:
    return map_learning.refine(known_map(), train(), CONFIG, jax.random.key(0))


@pytest.mark.slow
def test_held_out_views_are_predicted_better(refined) -> None:
    m, _ = refined
    scales = fit_scales(known_map(), train())
    before, after = held_out(known_map(), unseen(), scales), held_out(m, unseen(), scales)
    assert after.log_likelihood > before.log_likelihood + 0.05
    assert after.depth_l1 < before.depth_l1
    assert after.colour_l1 < before.colour_l1
    assert after.hit_share > before.hit_share - 0.01


def test_the_input_map_and_the_precisions_are_unchanged(refined) -> None:
    m, _ = refined
    again = closed_form(train())
    np.testing.assert_array_equal(np.asarray(known_map().occupancy), np.asarray(again.occupancy))
    np.testing.assert_array_equal(np.asarray(m.occupancy_precision), np.asarray(known_map().occupancy_precision))
    np.testing.assert_array_equal(np.asarray(m.colour_precision), np.asarray(known_map().colour_precision))


def test_the_empty_space_index_is_updated(refined) -> None:
    """After refinement the skipping search finds what the fixed march finds."""
    m, _ = refined
    T = unseen().T_world_cam[0]
    fast = emission.render(m, T, CAMERA)
    slow = emission.render_with(emission.march, m, T, CAMERA)
    assert float(np.mean(np.asarray(fast.hit) != np.asarray(slow.hit))) < 1e-3
    both = np.asarray(fast.hit & slow.hit)
    np.testing.assert_allclose(np.asarray(fast.depth)[both], np.asarray(slow.depth)[both], atol=1e-3)


def test_a_step_is_the_gradient_of_the_renderer() -> None:
    """A step from rays that hit is ``-rate s d(-log p)/dM``, by automatic differentiation through the whole map."""
    config, known = (
        MapLearningConfig(images=1, pixels=200, occupancy_rate=0.01, colour_rate=0.02),
        known_map(),
    )
    key, views = jax.random.key(3), train()[2:3]
    rays = map_learning._draw(known_map(), views, config, key)
    assert bool(jnp.all(rays.near))  # else the first-order term for missing surfaces would be in the step too

    def loss(occupancy, colour):
        m = VoxelMap(
            occupancy, known.occupancy_precision, colour, known.colour_precision, known.empty,
            known.origin, known.voxel_size, known.blocks,
        )  # fmt: skip
        d = emission.intersect(m, rays.centre[0], rays.direction, rays.k)
        p = rays.centre + rays.direction * jax.lax.stop_gradient(d)[:, None]
        off = jnp.abs(d - rays.depth) / SCALES.depth
        return jnp.sum(off) + jnp.sum(jnp.abs(m.field(p)[..., 1:] - rays.rgb)) / SCALES.rgb

    g_occupancy, g_colour = jax.grad(loss, argnums=(0, 1))(known_map().occupancy, known_map().colour)
    state, info = map_learning.step(map_learning.init(known_map()), views, config, key)
    np.testing.assert_allclose(
        np.asarray(state.map.occupancy - known_map().occupancy),
        -0.01 * SCALES.depth * np.asarray(g_occupancy),
        atol=2e-6,
    )
    np.testing.assert_allclose(
        np.asarray(state.map.colour - known_map().colour), -0.02 * SCALES.rgb * np.asarray(g_colour), atol=2e-6
    )
    assert float(info.hit_share) == 1.0


def test_a_missing_surface_grows() -> None:
    """In an empty map only the first-order term acts; it makes the surface that the images show."""
    config = MapLearningConfig(images=1, pixels=512, occupancy_rate=0.03, colour_rate=0.1)
    m, key = VoxelMap.prior(*GRID), jax.random.key(0)
    state = map_learning.init(m)
    for i in range(60):
        state, info = map_learning.step(state, train()[:1], config, jax.random.fold_in(key, i))
        if i % 20 == 19:
            state = map_learning.refresh(state)
    assert float(info.hit_share) > 0.8
    image = emission.render(state.map, train().T_world_cam[0], CAMERA)
    off = np.abs(np.asarray(image.depth) - np.asarray(train().depth[0]))[np.asarray(image.hit)]
    assert np.median(off) < 0.05


@pytest.mark.slow
def test_scales_of_a_refined_map_fit_its_images(refined) -> None:
    """They are of greatest likelihood: scales of another map or narrower ones explain the images worse."""
    m, scales = refined
    best = held_out(m, train(), scales).log_likelihood
    for other in (
        fit_scales(known_map(), train()),
        eqx.tree_at(lambda s: s.rgb, scales, 0.8 * scales.rgb),
        eqx.tree_at(lambda s: s.depth, scales, 0.8 * scales.depth),
    ):
        assert best > held_out(m, train(), other).log_likelihood


def test_held_out_by_hand() -> None:
    """Mean residuals and densities equal those of the rendered image."""
    view = unseen()[1:2]
    image = emission.render(known_map(), view.T_world_cam[0], CAMERA)
    both = np.asarray(image.known) & (np.asarray(view.depth[0]) > 0.0)
    d = np.abs(np.asarray(image.depth, float) - np.asarray(view.depth[0], float))[both]
    c = np.abs(np.asarray(image.rgb, float) - np.asarray(view.rgb[0], float) / 255.0)[both]
    seen = RGBD.from_camera(np.asarray(view.rgb[0]), np.asarray(view.depth[0]))
    got = held_out(known_map(), view, SCALES)
    np.testing.assert_allclose(got.depth_l1, d.mean(), rtol=1e-4)
    np.testing.assert_allclose(got.depth_median, np.median(d), rtol=1e-3)
    np.testing.assert_allclose(got.colour_l1, c.mean(), rtol=1e-4)
    np.testing.assert_allclose(got.log_likelihood, float(log_prob(seen, image, SCALES).total.mean()), rtol=1e-4)
    np.testing.assert_allclose(got.hit_share, both.mean(), rtol=1e-6)


def test_an_empty_map_pays_for_every_reading() -> None:
    """It predicts no surface: each reading has the density of an outlier, in depth and in colour."""
    got = held_out(VoxelMap.prior(*GRID), unseen(), SCALES)
    assert (unseen().depth > 0.0).all()
    other = fisk(3.0, scale=float(SCALES.outlier_depth))
    of_depth = other.logpdf(np.asarray(unseen().depth, float)).mean() - other.logcdf(MAX_DEPTH)
    assert got.log_likelihood == pytest.approx(np.log(1.0 - SCALES.empty_miss) + of_depth, rel=1e-3)
    assert got.log_likelihood < held_out(known_map(), unseen(), SCALES).log_likelihood - 2.0
    assert np.isnan(got.depth_l1)
    assert got.hit_share == 0.0


def test_readings_that_are_not_finite_are_ignored() -> None:
    depth = np.full((48, 64), 1.5, np.float32)
    depth[3, 4] = np.nan
    views = Views.stack([(np.zeros((48, 64, 3), np.uint8), depth)], np.eye(4)[None], CAMERA)
    assert float(views.depth[0, 3, 4]) == 0.0
    assert len(views) == 1
