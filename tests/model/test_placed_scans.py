"""Test that a placed model is the model in another frame."""

import jax
import jax.numpy as jnp
import numpy as np

from tests.helpers.plane.scan_room import AnalyticRoom, full_circle
from vssm_gym.geometry.planar_poses import compose
from vssm_gym.model.placed_scans import PlacedScans
from vssm_gym.model.scan_model import ScanModel

ROOM = AnalyticRoom(full_circle())
FRAME = np.array([0.4, -0.2, 2.1])


def test_scans_are_those_of_the_inner_pose():
    placed = PlacedScans(ROOM, jnp.asarray(FRAME, jnp.float32))
    assert isinstance(placed, ScanModel)
    inner = np.array([[0.2, 0.3, 0.7], [0.8, 0.1, -2.0]])
    outer = jnp.asarray(compose(FRAME, inner), jnp.float32)
    ranges = ROOM.ranges(jnp.asarray(inner, jnp.float32))
    np.testing.assert_allclose(placed.ranges(outer), ranges, atol=1e-4)
    np.testing.assert_allclose(
        placed.log_prob(ranges[0], outer), ROOM.log_prob(ranges[0], jnp.asarray(inner, jnp.float32)), atol=0.2
    )
    key = jax.random.key(0)
    np.testing.assert_allclose(placed.sample(key, outer), ROOM.sample(key, jnp.asarray(inner)), atol=1e-4)
    assert len(placed.scanner.angles) == 64
    assert isinstance(placed.draw_map(key), PlacedScans)
