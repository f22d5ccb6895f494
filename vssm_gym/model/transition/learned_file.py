"""Store learned transitions in files: a network, its units and the constants of its nominal step, without pickle.

A file is an ``.npz`` with a JSON header and one float32 array for each array of the transition, under the name of its
place in the tree. The header says how to build a transition of the same form, so that a load checks every shape.
"""

import hashlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.bounded import read_bytes
from vssm_gym.files.npz_file import open_npz
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.bicycle import Bicycle
from vssm_gym.model.transition.body_axes import body_axes
from vssm_gym.model.transition.calibrated import CalibratedDrive, CalibratedImu, ImuConstants
from vssm_gym.model.transition.imu import Imu
from vssm_gym.model.transition.learned import LearnedTransition, Scales, together, untrained
from vssm_gym.model.transition.motion_noise import MotionNoise
from vssm_gym.model.transition.planar import Planar

# Version 1 had one network in every file; since version 2 the header says how many there are.
FORMAT, VERSION = "vssm-gym-transition", 2
FILE_BYTES = 64 << 20  # a network of 5 layers of 64 has 0.1 MB
LARGEST = {"size": 64, "further": 64, "width": 1024, "depth": 32, "members": 16}  # of each number in the header

EXPECTED = "a learned transition (.npz); `vssm-gym train-dynamics` makes one"

# The nominal step of each kind of log, before calibration
NOMINALS: dict[str, Callable[[], Transition]] = {
    "imu": Imu,
    "holonomic": lambda: Planar(MotionNoise(turn=0.05, step=0.01)),
    "car": Bicycle,
}


class TransitionFile(NamedTuple):
    """Hold what a file says.

    Attributes:
        transition: that was learned.
        kind: of its controls: a key of ``NOMINALS``.
        trained: about its training: plain JSON values.
    """

    transition: LearnedTransition
    kind: str
    trained: dict[str, Any]


def calibrated(kind: str) -> CalibratedImu | CalibratedDrive:
    """Return the nominal step of a kind with constants that change nothing."""
    nominal = NOMINALS[kind]()
    if isinstance(nominal, Imu):
        return CalibratedImu(ImuConstants.zero(), nominal)
    return CalibratedDrive(nominal, jnp.eye(nominal.controls), jnp.zeros(nominal.controls))


def save_transition(path: str | Path, transition: LearnedTransition, kind: str, trained: dict[str, Any]) -> None:
    """Write a learned transition; the file is complete or absent, and equal transitions give equal files.

    Args:
        path: the file; one that exists is replaced.
        transition: whose nominal step is that of :func:`calibrated`, with any constants.
        kind: of its controls: a key of ``NOMINALS``.
        trained: about its training: plain JSON values.

    Raises:
        InputError: another nominal step than the one of this kind.
    """
    depth, width, _ = transition.network.layers[0].shape[-3:]
    named = _arrays(transition)
    numbers = {"size": transition.size, "further": transition.further, "width": width, "depth": depth}
    numbers["members"] = transition.members
    form = _form(kind, numbers) if kind in NOMINALS else None
    if form is None or type(form.nominal) is not type(transition.nominal) or _arrays(form).keys() != named.keys():
        raise InputError(path, "transition", f"a correction of the nominal step of {' or '.join(NOMINALS)}")
    header = {"format": FORMAT, "version": VERSION, "kind": kind, **numbers, "trained": trained}
    arrays = {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)}
    arrays |= {name: np.asarray(leaf, np.float32) for name, leaf in named.items()}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def load_transition(path: str | Path) -> TransitionFile:
    """Read and check a learned transition.

    Raises:
        InputError: no such file, another format or version, a field or an array that does not fit.
    """
    data = read_bytes(path, FILE_BYTES, EXPECTED)
    with open_npz(io.BytesIO(data), path, FILE_BYTES, EXPECTED) as stored:
        header = stored.read_json("header", path)
        found = (header.get("format"), header.get("version")) if isinstance(header, dict) else (None, None)
        if found[0] != FORMAT or found[1] not in (1, VERSION) or isinstance(found[1], bool):
            raise InputError(
                path, "version", f"{FORMAT} version 1 or {VERSION}; found {found[0]!s:.80} {found[1]!s:.80}"
            )
        if found[1] == 1:
            header = header | {"members": 1}
        kind, trained = header.get("kind"), header.get("trained")
        if not isinstance(kind, str) or kind not in NOMINALS:
            raise InputError(path, "kind", f"one of {', '.join(NOMINALS)}")
        if not isinstance(trained, dict):
            raise InputError(path, "trained", "what `vssm-gym train-dynamics` writes there")
        # Shapes alone: a header states sizes that the file need not hold
        form = eqx.filter_eval_shape(
            _form, kind, {name: _whole(path, name, header.get(name), most) for name, most in LARGEST.items()}
        )
        wanted = _arrays(form)
        if stored.shapes.keys() - {"header"} != wanted.keys():
            raise InputError(path, "arrays", f"{', '.join(sorted(wanted))}; found {', '.join(sorted(stored.shapes))}")
        arrays = {}
        for name, leaf in wanted.items():
            if stored.shapes[name] != leaf.shape:
                raise InputError(path, name, f"an array {leaf.shape}; found {stored.shapes[name]}")
            arrays[name] = stored.read(name)
            if arrays[name].dtype != np.float32 or not np.isfinite(arrays[name]).all():
                raise InputError(path, name, "finite numbers, float32")
    leaves = [jnp.asarray(arrays[name]) for name in wanted]
    parts, rest = eqx.partition(form, _is_array)
    transition = eqx.combine(jax.tree.unflatten(jax.tree.structure(parts), leaves), rest)
    for name, values in (("scales.spread", transition.scales.spread), ("scales.errors", transition.scales.errors)):
        if not (np.asarray(values) > 0.0).all():
            raise InputError(path, name, "positive numbers")
    if not float(transition.scales.step) > 0.0:
        raise InputError(path, "scales.step", "a positive number of seconds")
    return TransitionFile(transition, kind, trained)


def transition_hash(path: str | Path) -> str:
    """Return 16 hex digits of the content of a file of a learned transition."""
    return hashlib.sha256(read_bytes(path, FILE_BYTES, EXPECTED)).hexdigest()[:16]


def _form(kind: str, numbers: dict[str, int]) -> LearnedTransition:
    """Return a transition with arrays of the right shapes."""
    nominal = calibrated(kind)
    inputs, n = (
        body_axes(nominal.manifold).features + nominal.controls + numbers["further"],
        len(nominal.manifold.turns),
    )
    scales = Scales(jnp.zeros(inputs), jnp.ones(inputs), jnp.ones(n), jnp.ones(()))
    member = untrained(
        jax.random.key(0), nominal, scales, *(numbers[name] for name in ("size", "further", "width", "depth"))
    )
    return together([member] * numbers["members"])


def _arrays(transition: LearnedTransition) -> dict[str, Any]:
    """Return every array under the name of its place, in the order of the tree."""
    named = jax.tree_util.tree_flatten_with_path(eqx.filter(transition, _is_array))[0]
    return {jax.tree_util.keystr(path).replace("[", ".").replace("]", "").lstrip("."): leaf for path, leaf in named}


def _is_array(leaf: Any) -> bool:
    """Return True for an array, or for the shape of one."""
    return eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct)


def _whole(path: str | Path, name: str, value: Any, most: int) -> int:
    """Return a header's number."""
    least = 0 if name == "further" else 1
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise InputError(path, name, f"a whole number from {least} to {most}; found {value!r:.80}")
    return value
