"""Test the faults of a camera on images and trajectories that a reader can check by hand."""

import numpy as np
import pytest

from vssm_gym.errors import InputError
from vssm_gym.eval.faults.injectors import (
    CARD_DISTANCE,
    DEPTH_LAG,
    IMAGE_FAULTS,
    KIDNAP,
    MOTION_FAULTS,
    SCALE_ERROR,
    SHOVE,
    reordered,
)

SHAPE = (6, 8)


def images(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return images of which each pixel names its image and its column."""
    columns = np.arange(SHAPE[1])
    return [
        (
            np.tile((10 * k + columns)[:, None], (SHAPE[0], 1, 3)).astype(np.uint8),
            np.tile(1.0 + k + 0.1 * columns, (SHAPE[0], 1)).astype(np.float32),
        )
        for k in range(count)
    ]


def line(count: int, step: float) -> np.ndarray:
    """Return poses on a line, ``step`` metres apart."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = step * np.arange(count)
    return poses


@pytest.mark.parametrize("name", IMAGE_FAULTS)
def test_a_fault_keeps_the_form_of_images_and_leaves_the_true_ones_alone(name):
    taken = images(5)
    before = [(rgb.copy(), depth.copy()) for rgb, depth in taken]
    rgb, depth = IMAGE_FAULTS[name](taken, 3, np.random.default_rng(0))
    assert (rgb.shape, rgb.dtype, depth.shape, depth.dtype) == ((*SHAPE, 3), np.uint8, SHAPE, np.float32)
    assert any((a != taken[-1][i]).any() for i, a in enumerate((rgb, depth)))
    for (rgb, depth), (kept_rgb, kept_depth) in zip(taken, before, strict=True):
        np.testing.assert_array_equal(rgb, kept_rgb)
        np.testing.assert_array_equal(depth, kept_depth)


def test_each_fault_shows_what_it_says():
    taken, rng = images(DEPTH_LAG + 3), np.random.default_rng(0)
    rgb, depth = taken[-1]
    shown = {name: fault(taken, 2, rng) for name, fault in IMAGE_FAULTS.items()}
    assert not shown["blackout"][0].any()
    assert not shown["blackout"][1].any()
    np.testing.assert_array_equal(shown["frozen"][1], taken[1][1])
    assert abs(float(shown["grey card"][1].mean()) - CARD_DISTANCE) < 0.001
    assert shown["grey card"][0].std() < 5.0
    np.testing.assert_array_equal(shown["scaled depth"][0], rgb)
    np.testing.assert_allclose(shown["scaled depth"][1], SCALE_ERROR * depth, rtol=1e-6)
    np.testing.assert_array_equal(shown["swapped depth"][0], rgb)
    np.testing.assert_array_equal(shown["swapped depth"][1], taken[2][1])
    np.testing.assert_array_equal(shown["mirrored"][1][:, 0], depth[:, -1])


def test_a_card_never_gives_the_same_image_twice():
    taken, rng = images(3), np.random.default_rng(0)
    first, second = (IMAGE_FAULTS["grey card"](taken, 1, rng) for _ in range(2))
    assert (first[1] != second[1]).any()


def test_a_kidnapped_camera_comes_back_and_a_shoved_one_moves_on():
    poses = line(60, 0.11)
    order = 5 + np.arange(20)
    kidnapped = reordered("kidnap", poses, order, before=8, during=4)
    np.testing.assert_array_equal(kidnapped, [*range(5, 13), *range(17, 21), *range(17, 25)])
    shoved = reordered("shove", poses, order, before=8, during=4)
    np.testing.assert_array_equal(shoved, [*range(5, 13), *range(15, 27)])
    for name, away, moved in zip(MOTION_FAULTS, (KIDNAP, SHOVE), (kidnapped, shoved), strict=True):
        assert np.linalg.norm(poses[moved[8], :3, 3] - poses[moved[7], :3, 3]) >= away - 1e-9, name


def test_a_kidnap_leads_back_where_nothing_follows():
    """The recording ends near the fault: the camera is carried to the first place before it that is far enough."""
    moved = reordered("kidnap", line(22, 0.11), np.arange(20), before=15, during=4)
    np.testing.assert_array_equal(moved[15:19], [0, 1, 2, 3])


def test_a_shove_leads_back_where_nothing_follows():
    moved = reordered("shove", line(23, 0.055), np.arange(20), before=15, during=4)
    np.testing.assert_array_equal(moved[15:20], [0, 1, 2, 3, 4])


def test_a_kidnap_in_a_small_space_leads_to_its_farthest_place():
    moved = reordered("kidnap", line(30, 0.02), np.arange(20), before=5, during=4)
    np.testing.assert_array_equal(moved[5:9], [26, 27, 28, 29])


def test_a_camera_that_stays_in_one_place_cannot_be_carried_off():
    with pytest.raises(InputError, match=r"at least 0\.25 m away"):
        reordered("kidnap", line(60, 0.001), np.arange(20), before=8, during=4)
