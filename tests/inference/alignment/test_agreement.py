"""Test what confirms a pose: colours that agree, depth at its scale, and structure that fixes every coordinate."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import Room, camera_pose
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.alignment import reference_view
from vssm_gym.inference.alignment.agreement import Agreement, agreement, fixes_pose
from vssm_gym.inference.alignment.depth_scale import fits_unscaled
from vssm_gym.inference.alignment.residuals import AlignConfig, make_observed, make_reference, stride
from vssm_gym.inference.tracking.confirmation import ConfirmationConfig, colour_confirms
from vssm_gym.model.emission import RGBD

CAMERA = Camera.from_hfov(80, 60, np.radians(70.0))
ROOM = Room(((-2.0, -1.6, 0.0), (2.2, 1.7, 2.3)), (((0.9, -0.4, 0.0), (1.4, 0.5, 0.8)),))
CONFIG = AlignConfig()
HERE = camera_pose((-0.8, 0.1, 1.1), 0.1, 0.2)
WALL = camera_pose((1.4, 0.8, 1.5), 0.0)  # sees one wall and nothing else


@jax.jit
def agree(T: jax.Array, reference: RGBD, image: RGBD) -> Agreement:
    obs = make_observed(image, CAMERA, 1, stride(CAMERA, 1, CONFIG))
    return agreement(T, make_reference(reference, CAMERA, CONFIG), obs, CAMERA, 1, CONFIG)


@jax.jit
def fixed(reference: RGBD, image: RGBD) -> jax.Array:
    obs = make_observed(image, CAMERA, 1, stride(CAMERA, 1, CONFIG))
    return fixes_pose(jnp.eye(4), jnp.eye(6), make_reference(reference, CAMERA, CONFIG), obs, CAMERA, CONFIG, 0.03)


def painted(image: RGBD, value: float) -> RGBD:
    return eqx.tree_at(lambda i: i.rgb, image, jnp.full_like(image.rgb, value))


def test_an_image_agrees_with_itself() -> None:
    image = ROOM.image(HERE, CAMERA)
    same = agree(jnp.eye(4), image, image)
    assert float(same.cost) < 1e-3
    assert float(same.correlation) > 0.999
    grey = np.asarray(image.rgb).mean(axis=-1)
    assert float(same.contrast) == pytest.approx(grey.std() / CONFIG.rgb_sigma, rel=0.1)


def test_a_displaced_pose_a_mirrored_image_and_a_grey_one_do_not_agree() -> None:
    image = ROOM.image(HERE, CAMERA)
    aside = jnp.eye(4).at[0, 3].set(0.3)
    flipped = jax.tree.map(lambda a: a[:, ::-1], image)
    for T, shown in ((aside, image), (jnp.eye(4), flipped)):
        other = agree(T, image, shown)
        assert float(other.correlation) < 0.6
        assert float(other.cost) > 1.0
    grey = agree(jnp.eye(4), image, painted(image, 0.5))
    assert abs(float(grey.correlation)) < 0.1
    assert float(grey.contrast) < 1e-3


def test_the_correlation_does_not_depend_on_the_exposure() -> None:
    image = ROOM.image(HERE, CAMERA)
    dark = eqx.tree_at(lambda i: i.rgb, image, 0.4 * image.rgb)
    assert float(agree(jnp.eye(4), image, dark).correlation) > 0.999


def test_an_image_without_contrast_confirms_nothing_and_refutes_nothing() -> None:
    """A foreseen step is plausible in a grey image and not in a mirrored one; neither confirms another step."""
    image = ROOM.image(HERE, CAMERA)
    reference = reference_view.of_image(jnp.eye(4), image)

    @jax.jit
    def confirmed(shown: RGBD, expected: bool) -> jax.Array:
        here = jnp.eye(4)
        return colour_confirms(here, here[None], expected, reference, shown, CAMERA, CONFIG, ConfirmationConfig())

    shown = {"same": image, "grey": painted(image, 0.5), "mirrored": jax.tree.map(lambda a: a[:, ::-1], image)}
    foreseen = {name: (bool(confirmed(one, True)), bool(confirmed(one, False))) for name, one in shown.items()}
    assert foreseen == {"same": (True, True), "grey": (True, False), "mirrored": (False, False)}


def test_a_room_fixes_the_pose_and_a_bare_wall_does_not() -> None:
    room, wall = ROOM.image(HERE, CAMERA), ROOM.image(WALL, CAMERA)
    assert bool(fixed(room, room))
    assert bool(fixed(painted(room, 0.5), painted(room, 0.5)))  # by its shape alone
    assert bool(fixed(wall, wall))  # by its colours
    assert not bool(fixed(painted(wall, 0.5), painted(wall, 0.5)))


def test_weak_gradients_do_not_add_up() -> None:
    """Shades over a whole wall, of a fifth of a standard deviation a pixel, fix nothing."""
    wall = ROOM.image(WALL, CAMERA)
    u, v = jnp.arange(CAMERA.width)[None, :, None], jnp.arange(CAMERA.height)[:, None, None]
    shade = 0.5 + 0.2 * CONFIG.rgb_sigma * (jnp.abs(u % 20 - 10) + jnp.abs(v % 14 - 7)) * jnp.ones_like(wall.rgb)
    shaded = eqx.tree_at(lambda i: i.rgb, wall, shade)
    assert not bool(fixed(shaded, shaded))


@pytest.mark.parametrize(("scale", "fits"), [(1.0, True), (1.2, False), (0.83, False)])
def test_depth_fits_unscaled_where_its_scale_is_right(scale: float, fits: bool) -> None:
    """From the pose that explains scaled depth best, too: a camera that stands farther away or nearer."""
    image = ROOM.image(HERE, CAMERA)
    scaled = eqx.tree_at(lambda i: i.depth, image, scale * image.depth)
    T = jnp.eye(4).at[2, 3].set(-1.5 * (scale - 1.0))
    assert bool(fits_unscaled(T, jnp.eye(6), image, scaled, CAMERA, CONFIG)) == fits
