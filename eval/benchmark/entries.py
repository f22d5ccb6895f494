"""Find what enters the benchmark by a reference: a class in a file, in a module or of an installed package, or a name.

``FILE.py:CLASS`` · ``PACKAGE.MODULE:CLASS`` · a name of an entry point in the groups of :data:`GROUPS` · a name of what
comes with the package · a policy's file. One reference is enough for every track, because a class states by its methods
what it is, and an agent by its robot and task what it drives.
"""

import importlib
import importlib.util
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, TypeAlias

from vssm_gym.agents.base import ANY_TASK
from vssm_gym.agents.policy.policy_file import PREFIX, agent_label, policy_at
from vssm_gym.agents.registry import BUILT_IN, WITH, agent_type, make_agent, register_agent
from vssm_gym.envs.registration import ENVIRONMENTS
from vssm_gym.errors import InputError, did_you_mean
from vssm_gym.eval.benchmark.prediction.models import PREDICTORS
from vssm_gym.eval.benchmark.slam.methods import SLAM_METHODS
from vssm_gym.eval.benchmark.suite import DrivingTrack, SlamTrack, Suite, Track
from vssm_gym.eval.sweep.own_agents import code_hash
from vssm_gym.eval.sweep.supervision import reason_of

Kind: TypeAlias = Literal["agent", "slam", "predictor"]
METHODS: dict[Kind, tuple[str, ...]] = {
    "agent": ("reset", "act"),
    "slam": ("begin", "track", "finish"),
    "predictor": ("begin", "observe", "predict"),
}
GROUPS: dict[Kind, str] = {"agent": "vssm_gym.agents", "slam": "vssm_gym.slam", "predictor": "vssm_gym.predictors"}
"""Groups of entry points by which an installed package offers entries."""
_OWN: Mapping[Kind, Mapping[str, Callable[[], Any]]] = {"slam": SLAM_METHODS, "predictor": PREDICTORS}


@dataclass(frozen=True)
class Entry:
    """Hold what takes part in the benchmark.

    Attributes:
        reference: as it was given; a worker process finds the entry by it.
        kind: of the entry.
        label: names it in tables and rows; of an agent it is also what a sweep calls it.
        make: makes it, without arguments.
        code: hash of the code that the class is made of; None of what comes with the package.
    """

    reference: str
    kind: Kind
    label: str
    make: Callable[[], Any]
    code: str | None = None

    def enters(self, track: Track) -> bool:
        """Return whether a track is for this entry."""
        if not isinstance(track, DrivingTrack):
            return self.kind == ("slam" if isinstance(track, SlamTrack) else "predictor")
        if self.kind != "agent":
            return False
        agent, spec = agent_type(self.label_of_sweep), ENVIRONMENTS[track.config().env[0]]
        fits = agent.robot == spec.robot and agent.task in (spec.task, ANY_TASK)
        return fits and not (track.unmapped and agent.needs_map)

    @property
    def label_of_sweep(self) -> str:
        """Return the agent's name in a sweep's configuration: its label, or ``policy:FILE``."""
        return self.reference if self.reference.startswith(PREFIX) else self.label

    def tracks(self, suite: Suite) -> tuple[str, ...]:
        """Return the names of the tracks of a suite that it enters, in order."""
        return tuple(name for name, track in suite.tracks.items() if self.enters(track))


def find_entry(reference: str) -> Entry:
    """Return the entry of a reference, and make it once, so that a class that cannot be made is known at once.

    Raises:
        InputError: a reference to nothing, to what is no agent, SLAM method or world model, or to what cannot be made.
    """
    if reference.startswith(PREFIX) or (reference.endswith(".npz") and ":" not in reference):
        agent = policy_at(f"{PREFIX}{reference.removeprefix(PREFIX)}", Path())
        make_agent(agent)
        return Entry(agent, "agent", agent_label(agent), lambda: make_agent(agent))
    if ":" in reference:
        return _of_class(reference, _imported(reference))
    for kind, known in _OWN.items():
        if reference in known:
            return Entry(reference, kind, reference, known[reference])
    if reference.partition(WITH)[0] in BUILT_IN:
        make_agent(reference)
        return Entry(reference, "agent", reference, lambda: make_agent(reference))
    for kind, group in GROUPS.items():
        for point in entry_points(group=group, name=reference):
            found = _loaded(reference, point.load)
            return _of_class(reference, found, kind)
    offered = [point.name for group in GROUPS.values() for point in entry_points(group=group)]
    names = [*offered, *SLAM_METHODS, *PREDICTORS, *sorted(BUILT_IN)]
    forms = "FILE.py:CLASS, PACKAGE.MODULE:CLASS, the .npz file of a policy"
    groups = ", ".join(GROUPS.values())
    expected = f"{forms}, an entry point of {groups}, or a name of what comes with the package"
    raise InputError("benchmark", "entry", f"{expected}; found {reference!r:.80}{did_you_mean(names, reference)}")


def find_entries(references: tuple[str, ...], suite: Suite) -> tuple[Entry, ...]:
    """Return the entries of some references; raise :class:`InputError` for none, twins, or one that no track is for."""
    if not references:
        raise InputError("benchmark", "entry", "at least one, such as astar or my_agents.py:MyAgent")
    entries = tuple(find_entry(reference) for reference in references)
    labels = [entry.label for entry in entries]
    if twin := next((label for label in labels if labels.count(label) > 1), None):
        raise InputError("benchmark", "entry", f"entries with names that differ; two are called {twin!r}")
    for entry in entries:
        if not entry.tracks(suite):
            expected = f"one that a track of {suite.name} is for ({', '.join(suite.tracks)})"
            raise InputError("benchmark", "entry", f"{expected}; found {_described(entry)}")
    return entries


def _described(entry: Entry) -> str:
    """Return what an entry is, for an error."""
    if entry.kind != "agent":
        return f"{entry.label!r}, a {'SLAM method' if entry.kind == 'slam' else 'world model'}"
    agent = agent_type(entry.label_of_sweep)
    need = ", which needs a map" if agent.needs_map else ""
    return f"{entry.label!r}, an agent with robot {agent.robot!r} and task {agent.task!r}{need}"


def _of_class(reference: str, found: Any, kind: Kind | None = None) -> Entry:
    """Return the entry of a class of someone's; raise :class:`InputError` where it is none, or cannot be made."""
    methods = lambda one: all(callable(getattr(found, method, None)) for method in METHODS[one])
    if not isinstance(found, type):
        raise InputError("entry", reference, f"a class; found {type(found).__name__}")
    fitting = [one for one in METHODS if methods(one) and kind in (None, one)]
    if not fitting:
        forms = "; ".join(f"{one}: {', '.join(METHODS[one])}" for one in METHODS if kind in (None, one))
        raise InputError("entry", reference, f"a class with the methods of what it enters as ({forms})")
    name = getattr(found, "name", None)
    if not isinstance(name, str) or not name.isprintable() or not name:
        raise InputError("entry", reference, f"the class attribute name, a printable text; found {name!r:.80}")
    if fitting[0] == "agent":
        register_agent(found)  # which checks its attributes, too
        made = lambda: make_agent(name)
        _loaded(reference, made)
        return Entry(reference, "agent", name, made, code_hash(found))
    if name in {**SLAM_METHODS, **PREDICTORS}:
        raise InputError("entry", reference, f"a name that nothing of the package has; found {name!r}")
    _loaded(reference, found)
    return Entry(reference, fitting[0], name, found, code_hash(found))


def _loaded(reference: str, call: Callable[[], Any]) -> Any:
    """Return what some code of an entry returns; raise :class:`InputError` with its error."""
    try:
        return call()
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        expected = f"code that can be imported and made; {reason_of(error)}"
        raise InputError("entry", reference, expected) from error


def _imported(reference: str) -> Any:
    """Return the object of ``FILE.py:CLASS`` or ``MODULE:CLASS``."""
    where, _, name = reference.rpartition(":")
    if where.endswith(".py"):
        module = _module_of(reference, Path(where))
    else:
        _find_beside(Path.cwd())
        module = _loaded(reference, lambda: importlib.import_module(where))
    found = module
    for part in name.split("."):
        found = getattr(found, part, None)
    if found is None or found is module:
        classes = [k for k, v in vars(module).items() if isinstance(v, type) and v.__module__ == module.__name__]
        offered = f"a class of {where}{did_you_mean(classes, name)}"
        raise InputError("entry", reference, f"{offered}; it has {', '.join(classes) or 'none'}"[:400])
    return found


def _module_of(reference: str, path: Path) -> Any:
    """Import a file under its own name, as worker processes do, which are told the folders that are searched.

    The folder is searched last, so that no file in it takes the place of a module of someone else.
    """
    path = path.resolve()
    if not path.is_file():
        raise InputError("entry", reference, f"a Python file; there is none at {path}")
    if not path.stem.isidentifier():
        raise InputError("entry", reference, f"a file whose name is a word of Python; found {path.name!r}")
    _find_beside(path.parent)
    importlib.invalidate_caches()
    loaded = sys.modules.get(path.stem)
    spec = getattr(loaded, "__spec__", None) or _loaded(reference, lambda: importlib.util.find_spec(path.stem))
    if spec is None or spec.origin is None or Path(spec.origin).resolve() != path:
        raise InputError("entry", reference, f"a file whose name no other module has; {path.stem!r} is another's")
    return _loaded(reference, lambda: importlib.import_module(path.stem))


def _find_beside(folder: Path) -> None:
    """Let modules in a folder be imported, after all others."""
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
