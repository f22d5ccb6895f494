"""Test depth as a grey image."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.envs.sensors.depth_image import POLICY_MAX_DEPTH, depth_image


def test_by_hand():
    depth = np.array([[0.0, 1e-4, 1.0], [2.5, 5.0, 900.0]], np.float32)
    image = depth_image(depth)
    assert image.dtype == np.uint8 and image.shape == (2, 3, 1)
    assert image[..., 0].tolist() == [[0, 1, 51], [128, 255, 255]]


@given(st.floats(0.015625, 5.0, width=32))
def test_the_depth_is_known_to_two_centimetres(depth):
    grey = depth_image(np.full((1, 1), depth, np.float32)).item()
    assert 0.0 <= POLICY_MAX_DEPTH * grey / 255.0 - depth <= POLICY_MAX_DEPTH / 255.0 + 1e-5
