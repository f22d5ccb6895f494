"""Test the published solver on a robot that looks at the walls of a small room: it climbs the bound and finds poses."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import Room
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.smoothing.adam import ElboAdamConfig, Maximised, smooth
from vssm_gym.inference.smoothing.colour_network import ColourNetwork
from vssm_gym.inference.smoothing.elbo import VariationalPosterior
from vssm_gym.inference.smoothing.families import Chain, MeanField
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD, render
from vssm_gym.model.emission_density import EmissionScales
from vssm_gym.model.spatial_model import SpatialModel
from vssm_gym.model.transition import MotionNoise, Planar, planar_belief

ROOM = Room(((-0.8, -0.7, -0.4), (1.0, 0.7, 0.6)))
VIEW = Camera(12, 9, 6.0, 6.0, 5.5, 4.0)
T_BODY_CAM = jnp.asarray([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
TIME = 4
CONTROLS = jnp.tile(jnp.asarray([0.1, 0.0, 0.1]), (TIME - 1, 1))
CONFIG = ElboAdamConfig(steps=360, length=2, pixels=40, reported=120, states_rate=0.002, occupancy_rate=1e-4)


def transition() -> Planar:
    return Planar(MotionNoise(0.2, 0.1), (0.05, 0.05, 0.05))


def true_states() -> jax.Array:
    start = jnp.asarray([-0.3, -0.1, 0.1])
    return jnp.concatenate([start[None], transition().mean_path(start, CONTROLS, 0.2)])


def spatial(camera: Camera = VIEW) -> SpatialModel:
    prior = VoxelMap.prior((-1.2, -1.2, -1.2), 0.15, (16, 16, 16))
    return SpatialModel(transition(), prior, camera, T_BODY_CAM, EmissionScales(depth=0.03), max_depth=2.5)


def images(states: jax.Array) -> RGBD:
    poses = np.asarray(transition().manifold.pose(states) @ T_BODY_CAM, float)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(ROOM.image(T, VIEW) for T in poses))


def known_map(std: float = 0.005) -> VoxelMap:
    m = ROOM.to_map((-1.2, -1.2, -1.2), 0.15, (16, 16, 16))
    precisions = (jnp.full_like(m.occupancy_precision, std**-2), jnp.full_like(m.colour_precision, 0.05**-2))
    return eqx.tree_at(lambda m: (m.occupancy_precision, m.colour_precision), m, precisions)


def smoothed(
    family: type[MeanField | Chain],
    config: ElboAdamConfig = CONFIG,
    seen: int = TIME,
    camera: Camera = VIEW,
    off: float = 1.0,
    network: ColourNetwork | None = None,
) -> Maximised:
    """Smooth from states of which all but the first are 6 cm and 3 degrees off, times ``off``."""
    true = true_states()
    moved = true + off * jnp.asarray([0.05, -0.04, 0.05]) * (jnp.arange(TIME) > 0)[:, None]
    states = family.around(moved, jnp.full((TIME, 3), 0.01), transition().manifold)
    q = VariationalPosterior(states, known_map(), network)
    start = planar_belief(true[0], 1e-4 * jnp.eye(3))
    seen_images = jax.tree.map(lambda leaf: leaf[:seen], images(true))
    return smooth(jax.random.key(0), spatial(camera), start, q, CONTROLS, seen_images, jnp.full(TIME - 1, 0.2), config)


@pytest.mark.slow
@pytest.mark.parametrize("family", [MeanField, Chain])
def test_the_bound_rises_and_poses_come_nearer(family: type[MeanField | Chain]) -> None:
    found = smoothed(family)
    assert len(found.costs) == 3 and found.costs[-1] < found.costs[0]
    error = np.abs(np.asarray(found.states - true_states()))[1:]
    assert np.linalg.norm(error[:, :2], axis=1).mean() < 0.025  # of 6.4 cm
    assert error[:, 2].mean() < 0.02  # of 0.05 rad
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0
    assert np.isfinite(np.asarray(found.q.m.occupancy)).all()
    assert float(found.model.scales.depth) != pytest.approx(0.03, abs=1e-6)
    np.testing.assert_allclose(found.model.camera.fx, 6.0)  # intrinsics are not learned here


def test_intrinsics_are_learned_where_asked() -> None:
    """Poses and map are known, and both focal lengths stated 8 % too long."""
    stated = Camera(12, 9, 6.5, 6.5, 5.5, 4.0)
    config = replace(CONFIG, steps=240, intrinsics_rate=0.02, states_rate=0.0, occupancy_rate=0.0)
    found = smoothed(MeanField, config, camera=stated, off=0.0)
    focal = np.asarray([found.model.camera.fx, found.model.camera.fy])
    np.testing.assert_allclose(focal, 6.0, atol=0.12)  # 2 %; the walls are cells of 15 cm


@pytest.mark.slow
def test_a_network_of_colours_learns_what_the_images_show() -> None:
    """Poses and shape are known. The network begins grey; seen walls come nearer to their colours, in the map too."""
    grey = ColourNetwork.grey(jax.random.key(3), known_map(), width=64, layers=3)
    config = replace(CONFIG, steps=600, pixels=100, colour_rate=0.01, states_rate=0.0, occupancy_rate=0.0)
    found = smoothed(MeanField, config, off=0.0, network=grey)
    assert found.q.network is not None and found.costs[-1] < found.costs[0]
    np.testing.assert_array_equal(found.q.network.centre, grey.centre)
    off = {}
    for name, network in (("grey", grey), ("learned", found.q.network)):
        m = network.painted(known_map())
        shown = jax.vmap(lambda T, m=m: render(m, T, VIEW))(transition().manifold.pose(true_states()) @ T_BODY_CAM)
        off[name] = float(jnp.abs(shown.rgb - images(true_states()).rgb).mean())
    assert off["learned"] < 0.6 * off["grey"]  # cells with the true colours: 0.38


def test_an_image_for_each_state_is_asked_for() -> None:
    with pytest.raises(InputError, match="images"):
        smoothed(MeanField, seen=2)
