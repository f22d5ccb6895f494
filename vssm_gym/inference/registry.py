"""List every filter by name with the transitions that it takes; the command line and the tests read this table."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from vssm_gym.errors import InputError, one_of
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.filter import Filter, Rig
from vssm_gym.inference.prism.config import HAND_HELD, ROBOT_PRISM
from vssm_gym.inference.prism.filter import Prism
from vssm_gym.inference.tracking.config import TrackingConfig
from vssm_gym.inference.tracking.emission_tracking import TRACKER_ADAM, EmissionTracker
from vssm_gym.inference.tracking.map_tracker import ROBOT_TRACKING, DeadReckoning, FrameTracker, MapTracker
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
    config = ROBOT_TRACKING if transition.commanded else TrackingConfig()
    return MapTracker(rig, transition, replace(config, solver="adam", adam=TRACKER_ADAM, surface_error=None))


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


def make_filter(
    name: str, camera: Camera, transition: Transition, T_body_cam: Float[np.ndarray, "4 4"] | None = None
) -> Filter:
    """Make the filter of a name for a camera and the motion of the body that carries it.

    Args:
        name: ``prism`` (PRISM: the pose and the map), ``tracker`` (the pose in a given map; ``adam`` is the same with
            the published solver), ``emission`` (gradients through the renderer of a given map), ``frames`` (against the
            previous image) or ``dead_reckoning`` (controls alone).
        camera: of the images.
        transition: how the body moves. The options are those of a robot where its controls are commands, those of a
            hand-held camera elsewhere.
        T_body_cam: pose of the camera in the body frame, m; by default the camera is the body.

    Returns:
        A filter with ``init``, ``step`` and ``posterior``.

    Raises:
        InputError: an unknown name, or a filter that does not take the transition.
    """
    if name not in FILTERS:
        raise InputError("make_filter", "name", one_of(FILTERS, name))
    if name not in filters_for(transition):
        expected = f"one whose state is a pose with {name!r}; found {type(transition).__name__}"
        raise InputError("make_filter", "transition", expected)
    return FILTERS[name].make(Rig.of(camera, T_body_cam), transition)


def filters_for(transition: Any) -> list[str]:
    """Return the names of the filters that take a transition."""
    manifold = transition.manifold
    pose_alone = manifold.twists.shape[1] == len(manifold.turns)
    return [name for name, entry in FILTERS.items() if entry.any_state or pose_alone]
