"""Store policies in files: a deterministic policy's network as numbers and JSON, in an ``.npz`` without pickle.

    h_0 = features, or clip((features - shift) / scale, -bound, bound),
    h_i = f(W_i h_i-1 + b_i),   a = squash(W_n h_n-1 + b_n) in [-1, 1]^3,
    command = low + (a + 1) / 2 (high - low) = (turn rad, o rad, s m)

``f`` is tanh or ReLU; ``squash`` clips (PPO, cloning) or is tanh (SAC). Reading a file executes nothing that it holds,
and needs NumPy only: neither torch nor stable-baselines3. A file is written whole or not at all. Results name it by its
policy's name and the first hex digits of its SHA-256.
"""

import hashlib
import io
import json
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass, field, fields
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vssm_gym.agents.policy.features import OBSERVED, SIZES, size_of
from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.bounded import read_bytes
from vssm_gym.files.npz_file import StoredArrays, open_npz
from vssm_gym.files.numbers import as_float32
from vssm_gym.files.shipped import POLICIES, beside, or_shipped, shipped

POLICY_FORMAT = "vssm_gym.Policy"
POLICY_VERSION, NORMALISED_VERSION = 1, 2  # of files; the second ones hold a normalisation of the inputs
NORMALISATION = ("shift", "scale", "bound")  # arrays of such a file
PREFIX = "policy:"  # of agents' names that are a policy's file
HASH_DIGITS = 8  # hexadecimal, of a policy's content
POLICY_BYTES = 256 << 20  # of a file, and of its arrays; the policies trained here have 0.3 MB
MOST_LAYERS = 32  # hidden ones
LONGEST_POLICY_NAME = 200  # characters
LARGEST_LIMIT = 1e6  # m, rad: a bound of commands and distances, far beyond any robot's
ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {"tanh": np.tanh, "relu": lambda x: np.maximum(x, 0.0)}
SQUASHES: dict[str, Callable[[np.ndarray], np.ndarray]] = {"clip": lambda x: np.clip(x, -1.0, 1.0), "tanh": np.tanh}

_running: dict[str, str] = {}  # by path, labels of the policies that this process runs


@dataclass(frozen=True)
class PolicySpec:
    """Describe the numbers of a policy.

    Attributes:
        name: in tables.
        parts: of the observation that it reads (:mod:`vssm_gym.agents.policy.features`).
        frames: number of last steps whose vectors are the input, oldest first, zeros before the first.
        hidden: widths of the hidden layers.
        activation: ``f``.
        squash: of the last layer.
        low, high: commands at a = -1 and a = 1: turn (rad), direction (rad), step (m).
        max_depth: m, beyond which a scan has no measurement.
        hfov: rad, angle of the scan.
        success_radius: m, of the task that it was trained for.
        trained: algorithm, environment, steps, seconds, hashes of the training; only shown.
    """

    name: str
    parts: tuple[str, ...]
    frames: int
    hidden: tuple[int, ...]
    activation: str
    squash: str
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    max_depth: float
    hfov: float
    success_radius: float
    trained: dict[str, Any] = field(default_factory=dict)

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """Return (outputs, inputs) of each layer."""
        widths = [self.frames * size_of(self.parts), *self.hidden, len(self.low)]
        return [(n, m) for m, n in pairwise(widths)]


@dataclass(frozen=True)
class Normalisation:
    """``clip((x - shift) / scale, -bound, bound)`` of the inputs, each float64 ``(inputs,)``."""

    shift: np.ndarray
    scale: np.ndarray  # above 0
    bound: np.ndarray

    def __call__(self, vectors: Float[np.ndarray, "*batch inputs"]) -> Float[np.ndarray, "*batch inputs"]:
        """Return the inputs of the network, float32."""
        return np.clip((vectors - self.shift) / self.scale, -self.bound, self.bound).astype(np.float32)


@dataclass(frozen=True)
class Policy:
    """Hold a specification and its layers ``(W_i, b_i)``, float32; ``normalisation`` None: inputs are as they are."""

    spec: PolicySpec
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    normalisation: Normalisation | None = None

    def __call__(self, vectors: Float[np.ndarray, "*batch frames_features"]) -> Float[np.ndarray, "*batch 3"]:
        """Return commands for stacked feature vectors."""
        x = self.normalisation(vectors) if self.normalisation else vectors
        for i, (weight, bias) in enumerate(self.layers):
            x = x @ weight.T + bias
            last = i == len(self.layers) - 1
            x = SQUASHES[self.spec.squash](x) if last else ACTIVATIONS[self.spec.activation](x)
        low, high = np.array(self.spec.low), np.array(self.spec.high)
        return low + 0.5 * (x + 1.0) * (high - low)


def save(path: Path, policy: Policy) -> None:
    """Write a policy; equal policies give equal files."""
    version = NORMALISED_VERSION if policy.normalisation else POLICY_VERSION
    header = {"format": POLICY_FORMAT, "version": version, **asdict(policy.spec)}
    arrays = {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)}
    if policy.normalisation:
        arrays |= {name: getattr(policy.normalisation, name).astype(np.float64) for name in NORMALISATION}
    for i, (weight, bias) in enumerate(policy.layers):
        arrays |= {f"weight{i}": weight.astype(np.float32), f"bias{i}": bias.astype(np.float32)}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    _running.clear()


def load(path: str | Path) -> Policy:
    """Read and check a policy file.

    Raises:
        InputError: no such file, another format or version, a field or an array that does not fit.
    """
    return _parsed(path)[0]


def loaded(path: str) -> Policy:
    """Read a policy to run it, which :func:`label` names until this process saves one: rows name what was run."""
    policy, _running[path] = _read(path)
    return policy


def label(path: str | Path) -> str:
    """Return ``NAME@HASH``, the name of a file's policy in rows, tables and reports."""
    return _running.get(str(path)) or _read(str(path))[1]


def agent_label(agent: str) -> str:
    """Return the label of ``policy:PATH``; another agent's name as it is."""
    return label(agent.removeprefix(PREFIX)) if agent.startswith(PREFIX) else agent


def policy_at(agent: str, folder: Path) -> str:
    """Return ``policy:PATH`` with a relative path taken from ``folder``, and the name of a shipped policy as its path.

    Another agent's name is returned as it is.
    """
    if not agent.startswith(PREFIX):
        return agent
    return PREFIX + str(beside(agent.removeprefix(PREFIX), folder, POLICIES).resolve())


def _read(path: str) -> tuple[Policy, str]:
    """Return the policy and the label of a file; one that has not changed is read once."""
    file = shipped(path, POLICIES)
    found = file.stat() if file.is_file() else None
    return _unchanged(path, (found.st_ino, found.st_mtime_ns, found.st_size) if found else None)


@lru_cache(maxsize=64)
def _unchanged(path: str, state: tuple[int, ...] | None) -> tuple[Policy, str]:
    return _parsed(path)


def _parsed(path: str | Path) -> tuple[Policy, str]:
    """Read and check a policy file; return its policy and its label."""
    path = shipped(path, POLICIES)
    expected = f"a policy file (.npz); `vssm-gym train` makes one{or_shipped(POLICIES)}"
    data = read_bytes(path, POLICY_BYTES, expected)
    with open_npz(io.BytesIO(data), path, POLICY_BYTES, expected) as stored:
        header = stored.read_json("header", path)
        found = (header.pop("format", None), header.pop("version", None)) if isinstance(header, dict) else (None, None)
        if found not in [(POLICY_FORMAT, version) for version in (POLICY_VERSION, NORMALISED_VERSION)]:
            known = f"{POLICY_FORMAT} version {POLICY_VERSION} or {NORMALISED_VERSION}"
            raise InputError(path, "version", f"{known}; found {found[0]!s:.80} {found[1]!s:.80}")
        spec = _spec(path, header)
        layers = _layers(path, spec, stored)
        normalisation = _normalisation(path, spec, stored) if found[1] == NORMALISED_VERSION else None
    return Policy(spec, layers, normalisation), f"{spec.name}@{hashlib.sha256(data).hexdigest()[:HASH_DIGITS]}"


def _spec(path: str | Path, header: dict[str, Any]) -> PolicySpec:
    names = {one.name for one in fields(PolicySpec)}
    if set(header) != names:
        raise InputError(path, "header", f"the fields {', '.join(sorted(names))}; found {', '.join(sorted(header))}")
    tuples = {name: tuple(header[name]) for name in ("parts", "hidden", "low", "high") if _is_list(header[name])}
    checks = {
        "name": isinstance(header["name"], str) and 0 < len(header["name"]) <= LONGEST_POLICY_NAME,
        "parts": _is_list(header["parts"])
        and any(goal in header["parts"] for goal in ("goal", f"{OBSERVED}goal"))
        and len(header["parts"]) <= len(SIZES)
        and all(_one_of(part, SIZES) for part in header["parts"]),
        "frames": _whole(header["frames"], 64),
        "hidden": _is_list(header["hidden"])
        and len(header["hidden"]) <= MOST_LAYERS
        and all(_whole(width, 4096) for width in header["hidden"]),
        "activation": _one_of(header["activation"], ACTIVATIONS),
        "squash": _one_of(header["squash"], SQUASHES),
        "low": _is_list(header["low"]) and len(header["low"]) == 3 and all(map(_finite, header["low"])),
        "high": _is_list(header["high"]) and len(header["high"]) == 3 and all(map(_finite, header["high"])),
        "max_depth": _finite(header["max_depth"]) and header["max_depth"] > 0.0,
        "hfov": _finite(header["hfov"]) and 0.0 < header["hfov"] < np.pi,
        "success_radius": _finite(header["success_radius"]) and header["success_radius"] > 0.0,
        "trained": isinstance(header["trained"], dict),
    }
    for name, fits in checks.items():
        if not fits:
            raise InputError(path, name, f"what `vssm-gym train` writes there; found {header[name]!r:.80}")
    return PolicySpec(**(header | tuples))


def _layers(path: str | Path, spec: PolicySpec, stored: StoredArrays) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    layers = []
    for i, shape in enumerate(spec.shapes):
        pair = []
        for name, expected in ((f"weight{i}", shape), (f"bias{i}", shape[:1])):
            declared = stored.shapes.get(name)
            if declared != expected:
                raise InputError(path, name, f"float32 of shape {expected}; found {declared}")
            array = stored.read(name)
            if array.dtype != np.float32:
                raise InputError(path, name, f"float32 of shape {expected}; found {array.dtype}")
            pair.append(as_float32(array, path, name))
        layers.append((pair[0], pair[1]))
    return tuple(layers)


def _normalisation(path: str | Path, spec: PolicySpec, stored: StoredArrays) -> Normalisation:
    """Read the arrays of :data:`NORMALISATION`; each float64, finite, and all but ``shift`` above 0."""
    arrays, shape = {}, spec.shapes[0][1:]
    for name in NORMALISATION:
        if (declared := stored.shapes.get(name)) != shape:
            raise InputError(path, name, f"float64 of shape {shape}; found {declared}")
        array = stored.read(name)
        if array.dtype != np.float64 or not np.isfinite(array).all() or (name != "shift" and (array <= 0.0).any()):
            above = "" if name == "shift" else " above 0"
            raise InputError(path, name, f"finite float64{above}; found {array.dtype} {array.tolist()!r:.80}")
        arrays[name] = array
    return Normalisation(**arrays)


def _one_of(value: Any, known: Collection[str]) -> bool:
    return isinstance(value, str) and value in known


def _is_list(value: Any) -> bool:
    return isinstance(value, list)


def _whole(value: Any, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= most


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST_LIMIT
