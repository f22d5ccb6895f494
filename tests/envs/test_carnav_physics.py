"""Test both simulated cars: distance per wheel turn, the bicycle's circles, and collisions with walls."""

import math
import pickle
import subprocess
import sys

import numpy as np
import pytest

from tests.helpers.box_rooms import furniture
from tests.helpers.car_worlds import arc, yard
from vssm_gym.envs.carnav import CarNavEnv
from vssm_gym.envs.physics import MujocoCar
from vssm_gym.envs.robots.car_body import ackermann
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car

CAR = Car()
START = np.array([6.0, 6.0, 0.4])
YARD = yard()


@pytest.fixture(scope="module", params=["mujoco", "bullet"])
def body(request):
    if request.param == "mujoco":
        return MujocoCar(YARD, CAR)
    pytest.importorskip("pybullet", reason="the bullet extra is not installed")
    from vssm_gym.envs.physics.bullet_car import BulletCar

    return BulletCar(YARD, CAR)


def points(speed: float, steering: float, seconds: float) -> np.ndarray:
    return np.tile([speed, steering], (round(seconds * 100), 1))


def rolled(body, speed: float, steering: float, seconds: float) -> np.ndarray:
    """Return poses every 0.1 s, once the car has reached its speed."""
    body.reset(START)
    assert body.drive(points(speed, steering, 0.5), 1.0) == ()
    poses = [body.pose()]
    for _ in range(round(10 * seconds)):
        assert body.drive(points(speed, steering, 0.1), 1.0) == ()
        poses.append(body.pose())
    assert body.upright()
    return np.array(poses)


@pytest.mark.parametrize("speed", [-0.6, -0.2, 0.1, 0.3, 0.6])
def test_straight_on_it_covers_speed_times_time(body, speed):
    poses = rolled(body, speed, 0.0, 2.0)
    expected = arc(poses[0], 2.0 * speed, 0.0)
    np.testing.assert_allclose(poses[-1], expected, atol=0.02 * abs(2.0 * speed))
    assert body.speed() == pytest.approx(speed, rel=0.02)


@pytest.mark.parametrize("steering", [-0.5, -0.2, 0.1, 0.35, math.radians(30.0)])
@pytest.mark.parametrize("speed", [-0.3, 0.15, 0.6])
def test_it_turns_on_the_bicycles_circle(body, speed, steering):
    poses = rolled(body, speed, steering, 3.0)
    curvature = math.tan(steering) / CAR.wheelbase
    turned = np.unwrap(poses[:, 2])
    length = np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()
    assert (turned[-1] - turned[0]) / length == pytest.approx(math.copysign(1.0, speed) * curvature, rel=0.01)
    # the axle's own centre is the circle's radius away all the way, to its left where the curvature is positive
    heading = poses[:, 2]
    centres = poses[:, :2] + np.stack([-np.sin(heading), np.cos(heading)], axis=-1) / curvature
    np.testing.assert_allclose(centres, np.broadcast_to(centres[0], centres.shape), atol=0.02 / abs(curvature))


def test_mirrored_commands_mirror_the_motion(body):
    def run(sign):
        body.reset(np.array([6.0, 6.0, 0.0]))
        for k in range(20):
            body.drive(points(0.4 * math.cos(k / 6), sign * 0.5 * math.sin(k / 3), 0.1), 1.0)
        return body.pose() - [6.0, 6.0, 0.0]

    # PyBullet's impulses are solved in an order of their own: it is symmetric to a millimetre only
    np.testing.assert_allclose(run(1.0), run(-1.0) * [1.0, -1.0, -1.0], atol=2e-3)


def test_motion_does_not_depend_on_where_it_begins(body):
    ends = []
    for start in (np.array([3.0, 3.0, 0.0]), np.array([8.0, 7.0, 2.0])):
        body.reset(start)
        body.drive(points(0.4, 0.3, 1.5), 1.0)
        dx, dy, turn = body.pose() - start
        c, s = math.cos(start[2]), math.sin(start[2])
        ends.append([c * dx + s * dy, c * dy - s * dx, turn])
    np.testing.assert_allclose(ends[0], ends[1], atol=2e-3)


@pytest.mark.parametrize("friction", [1.0, 0.4, 0.2])
def test_it_brakes_as_hard_as_rear_tyres_allow(body, friction):
    """The distance lies between that with all weight on the braked axle, v^2 / (2 mu g), and that with half of it.

    The latter includes the shift of weight to the front.
    """
    body.reset(START)
    body.drive(points(0.6, 0.0, 2.0), friction)
    before, speed = body.pose(), body.speed()
    body.drive(points(0.0, 0.0, 1.5), friction)
    way = math.hypot(*(body.pose() - before)[:2])
    assert abs(body.speed()) < 2e-3
    assert (
        max(speed**2 / (2.0 * friction * 9.81), speed**2 / (2.0 * 4.2))
        < way
        < 0.01 + speed**2 / (0.75 * friction * 9.81)
    )


def test_at_rest_it_stays(body):
    body.reset(START)
    body.drive(points(0.0, 0.2, 3.0), 1.0)
    np.testing.assert_allclose(body.pose(), START, atol=1e-3)


def test_a_wall_stops_it_and_is_named_and_it_backs_off(body):
    nose = CAR.length - CAR.rear_overhang
    body.reset(np.array([11.95 - nose - 0.1, 6.0, 0.0]))
    assert body.drive(points(0.3, 0.0, 0.2), 1.0) == ()
    assert body.drive(points(0.3, 0.0, 0.5), 1.0) == ("wall 1",)
    assert body.drive(points(0.3, 0.0, 1.0), 1.0) == ("wall 1",)  # the contact lasts
    assert body.pose()[0] + nose == pytest.approx(11.95, abs=2e-3)
    assert body.upright()
    body.drive(points(-0.3, 0.0, 0.5), 1.0)
    assert body.drive(points(-0.3, 0.0, 0.5), 1.0) == ()
    assert body.pose()[0] < 11.95 - nose - 0.1


def test_contact_begins_at_the_cars_rectangle(body):
    """Backwards and at an angle, contact begins where the rectangle meets the wall, to 2 mm."""
    for heading in (math.pi, 2.4, 0.6):
        body.reset(np.array([11.0, 6.0, heading]))
        speed = 0.1 if math.cos(heading) > 0.0 else -0.1
        while not body.drive(points(speed, 0.0, 0.01), 1.0):
            reach = CAR.corners(body.pose())[:, 0].max()
            assert reach < 11.952
        assert CAR.corners(body.pose())[:, 0].max() == pytest.approx(11.95, abs=2e-3)


def test_same_commands_same_bytes(body):
    def run():
        body.reset(START)
        rng, poses = np.random.default_rng(0), []
        for _ in range(30):
            body.drive(points(*rng.uniform(-0.5, 0.5, 2), 0.1), 0.8)
            poses.append(body.pose())
        return np.array(poses).tobytes()

    assert run() == run()


def test_a_pickled_car_goes_on(body):
    body.reset(START)
    body.drive(points(0.4, 0.3, 1.0), 1.0)
    copy = pickle.loads(pickle.dumps(body))
    for one in (body, copy):
        one.drive(points(0.4, -0.3, 0.5), 1.0)
    exact = isinstance(body, MujocoCar)
    np.testing.assert_allclose(copy.pose(), body.pose(), atol=0.0 if exact else 2e-3)


@pytest.mark.parametrize("steering", [-0.5, 0.0, 0.01, 0.5])
def test_ackermanns_axes_meet_on_the_rear_axles_line(steering):
    left, right = ackermann(steering, CAR)
    # from each front wheel, along its axis, back to x = 0
    for angle, y in ((left, 0.5 * CAR.track), (right, -0.5 * CAR.track)):
        if steering:
            centre = y + CAR.wheelbase / math.tan(angle)
            assert centre == pytest.approx(CAR.wheelbase / math.tan(steering))
        else:
            assert angle == 0.0


def test_low_things_are_driven_over_and_high_ones_under():
    rug = furniture("rug", (2.0, 2.0, 0.004), (1.0, 1.0, 0.008))
    table = furniture("table top", (3.0, 2.0, 0.5), (1.0, 1.0, 0.1))
    box = furniture("box", (4.5, 2.0, 0.05), (0.4, 0.4, 0.1))
    body = MujocoCar(yard(6.0, 4.0, (rug, table, box)), CAR)
    body.reset(np.array([0.5, 2.0, 0.0]))
    assert body.drive(points(0.6, 0.0, 5.0), 1.0) == ()
    assert body.drive(points(0.6, 0.0, 2.0), 1.0) == ("box",)


def test_a_car_on_its_roof_is_not_upright():
    body = MujocoCar(YARD, CAR)
    assert body.upright()
    body.data.qpos[3:7] = 0.0, 1.0, 0.0, 0.0
    assert not body.upright()
    body.reset(START)
    body.data.qpos[2] = -0.5
    assert not body.upright()


def test_without_pybullet_the_message_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(InputError, match=r"environment: physics: expected the extra `bullet`") as caught:
        CarNavEnv(YARD, physics="bullet", images=False)
    assert "\n" not in str(caught.value)


def test_mujoco_does_not_load_pybullet():
    code = "import sys, vssm_gym.envs.carnav; print('pybullet' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.split() == ["False"]
