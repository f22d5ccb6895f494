"""Test PRISM on a floor: it maps an unknown room and localises in it, from images and commands alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.box_rooms import furniture, two_rooms
from tests.helpers.localisation_room import CAMERA, GRID, ROOM
from vssm_gym.data.recording import PROVENANCE, record
from vssm_gym.data.sequences import load_sequence
from vssm_gym.envs.robots import NOISE_LEVELS, ExecutionNoise, HolonomicRobot, execute
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import planar_to_matrix, wrap_angle
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.prism.config import ROBOT_PRISM
from vssm_gym.inference.prism.filter import Prism, PrismState
from vssm_gym.inference.status import Status
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD, render
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import MotionNoise, Planar, planar_belief
from vssm_gym.slam.drive_poses import estimate_poses
from vssm_gym.slam.map_building import build_map

ROBOT = HolonomicRobot()
RIG = Rig.of(CAMERA, ROBOT.T_body_cam)
EXECUTION = ExecutionNoise(np.radians(3.0), 0.02)
PRISM = Prism(RIG, Planar(MotionNoise(EXECUTION.turn, EXECUTION.step)), ROBOT_PRISM)
START = np.array([-0.5, -0.4, 2.9])
DARK = RGBD.from_camera(np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8), np.zeros((CAMERA.height, CAMERA.width)))


def see(planar: np.ndarray) -> RGBD:
    image = ROOM.image(planar_to_matrix(planar) @ ROBOT.T_body_cam, CAMERA)
    return RGBD.from_camera(np.rint(np.asarray(image.rgb) * 255).astype(np.uint8), np.asarray(image.depth))


def begin(start: np.ndarray = START) -> PrismState:
    known = planar_belief(jnp.asarray(start, jnp.float32), 1e-6 * jnp.eye(3))
    return PRISM.init(Posterior(known, VoxelMap.prior(*GRID)), see(start), jax.random.key(0))


def advance(state: PrismState, command: np.ndarray, image: RGBD) -> tuple[PrismState, Status]:
    state, info = PRISM.step(state, jnp.asarray(command, jnp.float32), image, ROBOT.dt)
    return state, info.status


def error(state: PrismState, planar: np.ndarray) -> tuple[float, float]:
    delta = np.asarray(PRISM.posterior(state).belief.mean, float) - planar
    return float(np.hypot(*delta[:2])), abs(float(wrap_angle(delta[2:])[0]))


@pytest.mark.slow
def test_an_unknown_room_is_mapped_at_its_true_place() -> None:
    """On a noisy circle pose and walls stay within 2 cm, where the commands alone are off by several."""
    rng, planar, reckoned, state = np.random.default_rng(3), START, START, begin()
    exact = ExecutionNoise(0.0, 0.0)
    for _ in range(30):
        command = np.array([0.18, rng.uniform(-0.08, 0.08), 0.08])
        planar = execute(planar, command, EXECUTION, rng)
        reckoned = execute(reckoned, command, exact, rng)
        state, status = advance(state, command, see(planar))
        assert status is Status.OK
        metres, radians = error(state, planar)
        assert metres < 0.02
        assert radians < 0.02
    assert np.hypot(*(reckoned - planar)[:2]) > 0.08
    T = planar_to_matrix(jnp.asarray(planar, jnp.float32)) @ RIG.T_body_cam
    seen, true = render(state.map, T, CAMERA), see(planar)
    both = np.asarray(seen.known & true.hit)
    assert both.mean() > 0.8
    assert np.median(np.abs(np.asarray(seen.depth - true.depth))[both]) < 0.03


@pytest.mark.parametrize(
    ("start", "stds"),
    [((-0.63, -0.21, -0.34), 2.24), ((-0.47, -0.33, -0.07), 2.41), ((0.0, -0.62, -0.63), 2.17), (START, -1.3)],
)
def test_a_turn_that_is_executed_badly_is_found(start: tuple[float, float, float], stds: float) -> None:
    """A robot that turned by 20 degrees more than predicted is out of reach of a search from the prediction alone."""
    noise = NOISE_LEVELS["high"]
    prism = Prism(RIG, Planar(MotionNoise(noise.turn, noise.step)), ROBOT_PRISM)
    turned = start + np.array([0.0, 0.0, max(0.0, 0.2 + stds * noise.turn)])
    state, info = prism.step(begin(np.array(start)), jnp.array([0.2, 0.0, 0.0]), see(turned), ROBOT.dt)
    assert info.status is Status.OK
    metres, radians = error(state, turned)
    assert metres < 0.02 and radians < 0.02


@pytest.mark.slow
def test_rejected_images_leave_the_map_unchanged_and_the_robot_is_relocalised() -> None:
    """During three covered images the pose follows the commands; then the robot is relocalised in the map."""
    rng, planar, state = np.random.default_rng(5), START, begin()
    command = np.array([0.1, 0.0, 0.05])
    for i in range(12):
        planar = execute(planar, command, EXECUTION, rng)
        covered = 5 <= i < 8
        before = np.asarray(state.map.occupancy_precision).sum()
        state, status = advance(state, command, DARK if covered else see(planar))
        assert status is (Status.LOST if covered else Status.OK)
        if covered:
            assert np.asarray(state.map.occupancy_precision).sum() == before
            assert state.lost
    assert error(state, planar)[0] < 0.03


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    folder = tmp_path_factory.mktemp("survey")
    table = furniture("table", (1.5, 2.0, 0.25), (0.6, 0.6, 0.5))
    save_scene(two_rooms(pieces=(table,)), folder / "rooms.json")
    record(folder / "rooms.json", folder / "drive", noise="low")
    return folder / "drive"


@pytest.mark.slow
def test_a_map_at_estimated_poses_equals_that_at_true_poses(survey):
    """In two rooms poses and surfaces agree to a few centimetres without ground truth."""
    sequence = load_sequence(survey)
    true, estimate = sequence.true_poses(), estimate_poses(sequence, 0.05)
    assert estimate.accepted.mean() > 0.98
    metres = np.linalg.norm(estimate.T_world_cam[:, :3, 3] - true[:, :3, 3], axis=1)
    assert np.median(metres) < 0.03
    assert metres.max() < 0.12
    assert metres[10:].min() > 0.0  # it is an estimate: the recorded poses have not leaked into it
    maps = [build_map(sequence, 0.05, poses=poses) for poses in ("recorded", "estimated")]
    images = [render(m, jnp.asarray(true[20], jnp.float32), sequence.camera) for m in maps]
    both = np.asarray(images[0].known & images[1].known)
    assert both.mean() > 0.7
    assert np.median(np.abs(np.asarray(images[0].depth - images[1].depth))[both]) < 0.03


def test_a_recording_without_commands_is_refused(survey, tmp_path):
    for path in survey.iterdir():
        if path.name != PROVENANCE:
            (tmp_path / path.name).symlink_to(path)
    with pytest.raises(InputError, match="controls: expected a survey that `vssm-gym record` drove"):
        estimate_poses(load_sequence(tmp_path), 0.05)
