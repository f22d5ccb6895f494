"""Test procedural textures: determinism, contrast in small images, seams."""

import numpy as np
import pytest

from vssm_gym.envs.textures.motifs import PICTURES
from vssm_gym.envs.textures.registry import TEXTURES, texture_atlas

SURFACES = sorted(set(TEXTURES) - set(PICTURES) | {"leaves"})
# Textures with an edge by design: fronts and panels, not continuous surfaces.
BOUNDED = {"cabinet", "drawers", "wainscot", "rug", "stripes", "plaid", "wicker", "checker"}


def grey(name: str) -> np.ndarray:
    return texture_atlas([name])[0].mean(axis=-1) / 255


def test_a_texture_does_not_depend_on_the_others() -> None:
    names = list(TEXTURES)
    together = texture_atlas(names)
    assert together.shape == (len(names), 128, 128, 3) and together.dtype == np.uint8
    assert (texture_atlas(names[::-1])[::-1] == together).all()
    assert (texture_atlas([names[5], names[2]]) == together[[5, 2]]).all()
    assert len({image.tobytes() for image in together}) == len(names)


def test_textures_do_not_share_their_arrays() -> None:
    atlas = texture_atlas(["wood"])
    before = atlas.copy()
    atlas[:] = 0
    assert (texture_atlas(["wood"]) == before).all()


@pytest.mark.parametrize("name", sorted(set(TEXTURES) - {"plain"}))
def test_contrast_survives_a_small_camera(name: str) -> None:
    # Averaged to 32 x 32 (3 to 6 cm on a tile of 1 to 2 m, a pixel at 3 m) something is left to track.
    coarse = grey(name).reshape(32, 4, 32, 4).mean(axis=(1, 3))
    assert coarse.std() > 0.025
    if name not in ("plaster", "stripes", "wainscot"):
        assert np.abs(np.diff(coarse, axis=0)).mean() + np.abs(np.diff(coarse, axis=1)).mean() > 0.02


def test_plain_paint_is_nearly_blank() -> None:
    assert grey("plain").std() < 0.015


@pytest.mark.parametrize("name", sorted(set(SURFACES) - BOUNDED))
def test_surfaces_repeat_without_a_seam(name: str) -> None:
    image = grey(name)
    for axis in (0, 1):
        steps = np.abs(np.diff(image, axis=axis)).mean(axis=1 - axis)
        seam = np.abs(np.take(image, 0, axis) - np.take(image, -1, axis)).mean()
        assert seam <= steps.max() * 1.2 + 0.01


@pytest.mark.parametrize(
    "name", ["planks", "laminate", "parquet", "tiles", "mosaic", "checker", "hexagons", "brick", "carpet"]
)
def test_no_part_of_a_floor_repeats_another(name: str) -> None:
    """A shifted floor correlates clearly less with itself, so that a tracker cannot slip by a tile."""
    image = grey(name)
    centred = image - image.mean()
    correlation = np.fft.ifft2(np.abs(np.fft.fft2(centred)) ** 2).real / (centred**2).sum()
    y, x = np.indices(correlation.shape)
    far = np.minimum(y, 128 - y) + np.minimum(x, 128 - x) > 16
    # On a chequered floor half the squares must agree after two steps; the rest comes from their shades.
    assert correlation[far].max() < (0.95 if name == "checker" else 0.8)
