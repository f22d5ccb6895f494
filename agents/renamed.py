"""Define which agents were renamed.

Rows and manifests on disk may hold a former name and are read under the present one. Asking for an agent by a former
name is an error. This module imports no agent, because rows are also read where none runs.
"""

from vssm_gym.errors import InputError

RENAMED = {
    "frontier_looking": "frontier_gain_scan",
    "candidate_random": "random_viewpoint",
    "vi_mpc_tracked": "vi_mpc_estimated_pose",
    "mi_explorer_tracked": "mi_explorer_estimated_pose",
    "frontier_gain_tracked": "frontier_gain_estimated_pose",
    "frontier_looking_tracked": "frontier_gain_scan_estimated_pose",
}
"""Present name of an agent by its former one."""

_FORMER = {present: former for former, present in RENAMED.items()}


def current_name(name: str) -> str:
    """Return the present name of an agent that a file calls ``name``."""
    return RENAMED.get(name, name)


def hashed_name(name: str) -> str:
    """Return the former name of a renamed agent: a configuration's hash uses it, so that the hash stays the same."""
    return _FORMER.get(name, name)


def refuse_former(name: str, source: object, field: str) -> None:
    """Raise :class:`InputError` with the present name where an agent is given by a former one."""
    if name in RENAMED:
        raise InputError(source, field, f"{RENAMED[name]!r}, the present name of that agent; found {name!r}")
