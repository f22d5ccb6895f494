"""List every filter by name with the transitions that it takes; the command line and the tests read this table."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from vssm_gym.inference.filter import Filter, Rig
from vssm_gym.inference.prism.config import HAND_HELD
from vssm_gym.inference.prism.config import ROBOT as ROBOT_PRISM
from vssm_gym.inference.prism.filter import Prism
from vssm_gym.inference.tracking.camera_filter import TrackingConfig
from vssm_gym.inference.tracking.emission_tracking import TRACKER_ADAM, EmissionTracker
from vssm_gym.inference.tracking.map_tracker import ROBOT, DeadReckoning, FrameTracker, MapTracker
from vssm_gym.inference.tracking.recovery import RecoveryConfig
from vssm_gym.model.transition.base import Transition


class FilterEntry(NamedTuple):
    """Describe a filter: how it is made for a transition, its requirements and its abilities."""

    make: Callable[[Rig, Transition], Filter]
    needs_map: bool  # whether the prior must hold a learned map
    maps: bool  # whether the posterior holds a map that it learned
    any_state: bool  # whether a state may hold more than a pose
    blind: bool = False  # whether it uses no image


def _prism(rig: Rig, transition: Transition) -> Filter:
    return Prism(rig, transition, ROBOT_PRISM if transition.commanded else HAND_HELD)


def _tracker(rig: Rig, transition: Transition) -> Filter:
    if transition.commanded:
        return MapTracker(rig, transition)
    return MapTracker(rig, transition, TrackingConfig(), RecoveryConfig())


def _adam(rig: Rig, transition: Transition) -> Filter:
    """Make the tracker with the published solver."""
    config = ROBOT if transition.commanded else TrackingConfig()
    return MapTracker(rig, transition, replace(config, solver="adam", adam=TRACKER_ADAM))


FILTERS: dict[str, FilterEntry] = {
    "prism": FilterEntry(_prism, needs_map=False, maps=True, any_state=True),
    "tracker": FilterEntry(_tracker, needs_map=True, maps=False, any_state=True),
    "adam": FilterEntry(_adam, needs_map=True, maps=False, any_state=True),
    "emission": FilterEntry(EmissionTracker, needs_map=True, maps=False, any_state=False),
    "frames": FilterEntry(FrameTracker, needs_map=False, maps=False, any_state=False),
    "dead_reckoning": FilterEntry(
        lambda rig, transition: DeadReckoning(transition), needs_map=False, maps=False, any_state=True, blind=True
    ),
}


def filters_for(transition: Any) -> list[str]:
    """Return the names of the filters that take a transition."""
    manifold = transition.manifold
    pose_alone = manifold.twists.shape[1] == len(manifold.turns)
    return [name for name, entry in FILTERS.items() if entry.any_state or pose_alone]
