"""Test which estimates are believed, with a filter that does as the test says, and the rule for a robot without one."""

import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.agents.shared.localization import localized
from vssm_gym.agents.shared.trust import TRUST, Conduct, JudgedFilter, LostConfig, TrustConfig, gave_up
from vssm_gym.inference.alignment.residuals import AlignInfo
from vssm_gym.inference.filter import FilterInfo
from vssm_gym.inference.relocalisation.relocaliser import Found, Hypothesis, Outcome
from vssm_gym.inference.status import Status
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import MotionNoise, Planar, planar_belief

OK, LOST, NO_READING, REPEATED, FROZEN, UNCONFIRMED = (
    Status.OK,
    Status.LOST,
    Status.NO_READING,
    Status.REPEATED,
    Status.FROZEN,
    Status.UNCONFIRMED,
)
DRIVE, TURN, STAND = np.array([0.0, 0.0, 0.16]), np.array([0.2, 0.0, 0.0]), np.zeros(3)
CONFIRM = TrustConfig().confirm


class Scripted:
    """Report the statuses of a list, and keep the commands; a dark image moves the belief by the command alone."""

    transition = Planar(MotionNoise(0.05, 0.02))

    def __init__(self, *statuses: Status, photometric: float = 0.5, inlier_share: float = 0.9) -> None:
        self.statuses, self.photometric, self.inlier_share = list(statuses), photometric, inlier_share
        self.steps: list[tuple[tuple[float, ...], bool]] = []  # command, and whether there was an image

    def init(self, prior, image, key):
        return np.zeros(3)

    def step(self, state, control, image, dt, clock=None):
        seen = bool(np.any(np.asarray(image.depth) > 0.0))
        self.steps.append((tuple(np.asarray(control, np.float64).round(3).tolist()), seen))
        status = LOST if not seen or not self.statuses else self.statuses.pop(0)
        moved = state if seen else np.asarray(self.transition.mean(jnp.asarray(state), control, dt))
        share, photometric = jnp.float32(self.inlier_share), jnp.float32(self.photometric)
        quality = AlignInfo(share, jnp.ones(()), photometric, jnp.eye(3), jnp.zeros((), int))
        return moved, FilterInfo(status, self.belief(moved), quality)

    def posterior(self, state):
        return Posterior(self.belief(state), None)

    def belief(self, state):
        return planar_belief(jnp.asarray(state, jnp.float32), 1e-4 * jnp.eye(3))


class ShortOfDepth(Scripted):
    """Follow the command where the script has no reading, at the noise level low."""

    transition = Planar(MotionNoise(np.radians(3.0), 0.02))


def image(seed: int, depth: float = 1.0) -> dict[str, np.ndarray]:
    """Return an image of grey noise in front of a wall."""
    rng = np.random.default_rng(seed)
    return {"rgb": rng.integers(0, 256, (12, 16, 3), np.uint8), "depth": np.full((12, 16), depth, np.float32)}


def judged(filter: Scripted, chained: bool = False) -> JudgedFilter:
    return JudgedFilter(filter, filter.init(None, None, None), 0.2, image(0), chained)


def test_a_lost_robot_believes_again_after_several_images_that_fit():
    """One that fits by chance in between starts the count anew; the steps in a row are counted."""
    track = judged(Scripted(OK, LOST, OK, LOST, *[OK] * (CONFIRM + 1)))
    outcomes = [track.step(DRIVE, image(k)) for k in range(1, CONFIRM + 6)]
    assert [one.status for one in outcomes] == [OK, LOST, UNCONFIRMED, LOST, *[UNCONFIRMED] * (CONFIRM - 1), OK, OK]
    assert [one.lost for one in outcomes] == [0, *range(1, CONFIRM + 3), 0, 0]


@pytest.mark.parametrize(
    ("photometric", "inlier_share", "status"), [(0.5, 0.9, OK), (1.5, 0.7, OK), (3.9, 0.9, LOST), (0.5, 0.6, LOST)]
)
def test_an_image_that_the_map_does_not_explain_does_not_fit(photometric, inlier_share, status):
    """Noise has a contrast of 3.3 standard deviations of the alignment, which the residual may not exceed."""
    filter = Scripted(OK, photometric=photometric, inlier_share=inlier_share)
    assert judged(filter).step(DRIVE, image(1)).status is status


def test_a_chain_of_images_that_broke_is_not_believed_again():
    track = judged(Scripted(LOST, *[OK] * 9), chained=True)
    assert [track.step(DRIVE, image(k)).lost for k in range(1, 9)] == list(range(1, 9))


def test_a_chain_with_an_image_that_does_not_fit_is_not_believed_again():
    """The filter accepted the image, and has taken the step that it showed."""
    filter = Scripted(*[OK] * 9)
    track = judged(filter, chained=True)
    filter.photometric = 9.0
    assert track.step(DRIVE, image(1)).status is LOST
    filter.photometric = 0.5
    assert [track.step(DRIVE, image(k)).lost for k in range(2, 8)] == list(range(2, 8))


@pytest.mark.parametrize(("command", "steps", "broken"), [(TURN, 1, False), (TURN, 2, True), (DRIVE, 4, False)])
def test_a_chain_of_images_survives_little_motion_without_them(command, steps, broken):
    """At low noise a turn has a standard deviation of 3 degrees, a drive one of 2 cm."""
    track = JudgedFilter(ShortOfDepth(*[NO_READING] * steps, *[OK] * 9), np.zeros(3), 0.2, image(0), chained=True)
    for k in range(1, steps + 6):
        last = track.step(command, image(k))
    assert (last.lost > 0) == broken


@pytest.mark.parametrize("depth", [0.0, np.nan, np.inf])
def test_a_dark_image_is_no_reading(depth):
    assert judged(Scripted(OK)).step(DRIVE, image(1, depth=depth)).status is NO_READING


def test_frozen_images_are_replaced_by_the_commands_that_they_deny():
    """Once two turns have shown that the camera is frozen, the belief is where all commands since then have led."""
    filter = Scripted(*[OK] * 9)
    track = judged(filter)
    commands = [DRIVE, DRIVE, DRIVE, DRIVE, TURN, TURN, STAND]
    outcomes = [track.step(command, image(0)) for command in commands]
    assert [one.status for one in outcomes] == [OK, OK, OK, REPEATED, REPEATED, FROZEN, FROZEN]
    assert [seen for _, seen in filter.steps] == [True] * 3 + [False] * 7
    assert [command for command, seen in filter.steps if not seen] == [tuple(c.tolist()) for c in commands]
    np.testing.assert_allclose(outcomes[-1].belief.mean, [0.64, 0.0, 0.4], atol=1e-5)
    assert outcomes[-1].lost == 4
    assert track.step(STAND, image(1)).status is UNCONFIRMED
    assert filter.steps[-1] == ((0.0, 0.0, 0.0), True)


def test_the_belief_follows_each_command_once_while_black_images_repeat():
    """A black image moves the belief by the command, the first four of them; so do the commands that follow."""
    track = judged(Scripted())
    commands = [DRIVE, DRIVE, DRIVE, DRIVE, DRIVE, TURN, TURN, STAND]
    outcomes = [track.step(command, image(1, depth=0.0)) for command in commands]
    assert [one.status for one in outcomes] == [*[NO_READING] * 4, REPEATED, REPEATED, FROZEN, FROZEN]
    np.testing.assert_allclose(outcomes[-1].belief.mean, [0.8, 0.0, 0.4], atol=1e-5)


class Elsewhere:
    """Find so many images at one place, by default all."""

    map = None

    def __init__(self, times: int = 99) -> None:
        self.times = times

    def find(self, image):
        if self.times == 0:
            return Found(Outcome.NOTHING)
        self.times -= 1
        belief = planar_belief(jnp.asarray([5.0, 5.0, 1.0]), 1e-4 * jnp.eye(3))
        return Found(Outcome.FOUND, (Hypothesis(np.array([5.0, 5.0, 1.0]), 0.0),), belief)


class Placed(Scripted):
    """Begin where the prior says."""

    def init(self, prior, image, key):
        return np.zeros(3) if prior is None else np.asarray(prior.belief.mean)

    def step(self, state, control, image, dt, clock=None):
        moved, info = super().step(state, control, image, dt, clock)
        if info.status is LOST:
            moved = np.asarray(self.transition.mean(jnp.asarray(state), control, dt))
        return moved, info._replace(belief=self.belief(moved))


@pytest.mark.parametrize("fits", [1, CONFIRM - 1, CONFIRM])
def test_the_estimate_leaves_for_another_place_when_that_is_confirmed(fits):
    """Until then, and where an image does not fit there, it is where the commands lead from the last one."""
    early = TrustConfig().relocalise
    filter = Placed(*[LOST] * (early + 1), *[OK] * (fits - 1), LOST)
    track = JudgedFilter(filter, np.zeros(3), 0.2, image(0), relocaliser=Elsewhere)
    outcomes = [track.step(DRIVE, image(k)) for k in range(1, early + fits + 2)]
    found = [one.status for one in outcomes[early:]]
    last = UNCONFIRMED if fits < CONFIRM else LOST  # found there once more, or followed from there
    assert found == [*[UNCONFIRMED] * min(fits, CONFIRM - 1), *[OK] * (fits == CONFIRM), last]
    confirmed = early + CONFIRM
    for k, one in enumerate(outcomes, 1):
        if fits == CONFIRM and k >= confirmed:
            c, s = 0.16 * (k - confirmed) * np.cos(1.0), 0.16 * (k - confirmed) * np.sin(1.0)
            expected = [5.0 + c, 5.0 + s, 1.0]
        else:
            expected = [0.16 * k, 0.0, 0.0]
        np.testing.assert_allclose(one.belief.mean, expected, atol=1e-5)
        np.testing.assert_allclose(one.in_world.mean, expected, atol=1e-5)


def lost_and_found(*after: Status, config: TrustConfig = TRUST) -> JudgedFilter:
    """Return a filter that was lost for long enough, and has been found elsewhere at its fourth image, once."""
    filter = Placed(*[LOST] * (TrustConfig().relocalise + 1), *after)
    finder = Elsewhere(times=1)
    track = JudgedFilter(filter, np.zeros(3), 0.2, image(0), config=config, relocaliser=lambda: finder)
    for k in range(1, TrustConfig().relocalise + 2):
        track.step(DRIVE, image(k))
    return track


def test_an_image_that_refutes_a_place_is_compared_with_the_place_before():
    """It fits there: from now on as many images have to fit there as at any other place."""
    track = lost_and_found(OK, LOST, *[OK] * CONFIRM)
    outcomes = [track.step(DRIVE, image(k)) for k in range(10, 11 + CONFIRM)]
    assert [one.status for one in outcomes] == [*[UNCONFIRMED] * CONFIRM, OK]
    for one in outcomes:  # five commands were followed, and an image that fits shows no motion here
        np.testing.assert_allclose(one.belief.mean, [0.8, 0.0, 0.0], atol=1e-5)
        np.testing.assert_allclose(one.in_world.mean, one.belief.mean)


def test_a_place_that_was_left_is_gone_on_from_where_nothing_fits():
    track = lost_and_found(OK, LOST, LOST)
    outcomes = [track.step(DRIVE, image(k)) for k in (10, 11)]
    assert [one.status for one in outcomes] == [UNCONFIRMED, LOST]
    for commands, one in zip((5, 6), outcomes, strict=True):
        np.testing.assert_allclose(one.belief.mean, [0.16 * commands, 0.0, 0.0], atol=1e-5)
        np.testing.assert_allclose(one.in_world.mean, one.belief.mean)


def test_a_place_that_was_left_follows_each_command_once_while_images_freeze():
    track = lost_and_found(*[OK] * 4, config=TrustConfig(confirm=9))
    outcomes = [track.step(command, image(10)) for command in (DRIVE, *[TURN] * 5)]
    assert outcomes[-1].status is FROZEN
    for turns, one in enumerate(outcomes):
        np.testing.assert_allclose(one.belief.mean, [0.8, 0.0, 0.2 * turns], atol=1e-5)
    after = track.step(DRIVE, image(11))
    assert after.status is LOST
    np.testing.assert_allclose(after.belief.mean, [0.8 + 0.16 * np.cos(1.0), 0.16 * np.sin(1.0), 1.0], atol=1e-5)


class Drifting(Scripted):
    """State a wider belief in the world than in the map, as a filter does whose map drifts."""

    def step(self, state, control, image, dt, clock=None):
        moved, info = super().step(state, control, image, dt, clock)
        wide = planar_belief(info.belief.mean, info.belief.covariance + jnp.diag(jnp.asarray([0.0, 0.04, 0.01])))
        return moved, info._replace(belief=wide)


def test_the_drift_of_the_map_is_in_the_covariance_that_is_stated_and_not_in_what_is_planned_by():
    """While images repeat the filter makes no step, and the last belief stands."""
    track = judged(Drifting(*[OK] * 9))
    outcomes = [localized(track.step(command, image(seed))) for command, seed in ((TURN, 1), (DRIVE, 2), (STAND, 2))]
    for found in outcomes:
        np.testing.assert_allclose(found.covariance, np.diag([1e-4, 0.0401, 0.0101]), rtol=1e-5)
        np.testing.assert_allclose(found.std, 0.01, rtol=1e-5)


def test_a_robot_that_was_held_was_where_its_images_said():
    """It turns, the image changes: the commands that moved nothing are not made up for."""
    filter = Scripted(*[OK] * 9)
    track = judged(filter)
    outcomes = [track.step(DRIVE, image(0)) for _ in range(6)]
    assert [one.status for one in outcomes] == [OK, OK, OK, REPEATED, REPEATED, REPEATED]
    after = [track.step(TURN, image(k)) for k in range(1, CONFIRM + 1)]
    assert after[-1].status is OK
    np.testing.assert_allclose(after[-1].belief.mean, np.zeros(3))
    assert all(seen for _, seen in filter.steps)


def test_the_rule_of_a_lost_robot():
    rule = LostConfig(coast=2, give_up=5)
    assert [rule.conduct(lost, LOST) for lost in range(7)] == [
        Conduct.FOLLOW,
        *[Conduct.COAST] * 2,
        *[Conduct.SEARCH] * 3,
        Conduct.GIVE_UP,
    ]
    assert rule.conduct(1, REPEATED) is Conduct.SEARCH  # a turn tells a frozen camera from a robot that is held
    assert rule.conduct(1, FROZEN) is Conduct.WAIT
    assert rule.conduct(6, FROZEN) is Conduct.GIVE_UP
    assert gave_up(6).startswith("gave up: lost")
