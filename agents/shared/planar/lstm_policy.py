"""Hold a deterministic LSTM policy over scans: its forward pass, its vector of parameters, and its file.

    (i, f, g, o) = W [x; h] + b,    c' = sigmoid(f) c + sigmoid(i) tanh(g),    h' = sigmoid(o) tanh(c')
    turn = turn_max tanh(a_0),    step = step_max sigmoid(a_1),    a = V h' + d

``x`` are as many of the scan's ranges as the policy has inputs, evenly apart from the one ahead on, less their mean and
over their standard deviation in training. A file is an ``.npz`` without pickle; reading it executes nothing.
"""

import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.bounded import read_bytes
from vssm_gym.files.npz_file import open_npz
from vssm_gym.files.numbers import as_float32

LSTM_FORMAT, LSTM_VERSION = "vssm_gym.LstmPolicy", 1
LSTM_BYTES = 16 << 20  # of a file, and of its arrays
COMMANDS = 2  # turn and step
MOST_WIDE = 1024  # inputs, and units, of a policy in a file


@dataclass(frozen=True)
class LstmPolicy:
    """Hold the numbers of a policy.

    Attributes:
        inputs: ranges that it reads.
        hidden: units.
        parameters: ``W, b, V, d`` in one vector, row by row.
        mean: of each input, m.
        std: of each input, m.
        trained: where and how; only shown.
    """

    inputs: int
    hidden: int
    parameters: Float[np.ndarray, "n"]
    mean: Float[np.ndarray, "inputs"]
    std: Float[np.ndarray, "inputs"]
    trained: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        size = size_of(self.inputs, self.hidden)
        if self.parameters.shape != (size,):
            raise InputError("LstmPolicy", "parameters", f"{size} numbers; found {self.parameters.shape}")

    def start(self) -> Float[np.ndarray, "2 hidden"]:
        """Return ``h`` and ``c`` before the first scan."""
        return np.zeros((2, self.hidden))

    def step(
        self, state: Float[np.ndarray, "2 hidden"], ranges: Float[np.ndarray, "inputs"], limits: Float[np.ndarray, "2"]
    ) -> tuple[Float[np.ndarray, "2 hidden"], Float[np.ndarray, "2"]]:
        """Return the next state and the command ``(turn rad, step m)`` for ranges (m)."""
        W, b, V, d = unpacked(np.asarray(self.parameters, np.float64), self.inputs, self.hidden)
        x = (ranges - self.mean) / self.std
        i, f, g, o = np.split(W @ np.concatenate([x, state[0]]) + b, 4)
        c = _sigmoid(f) * state[1] + _sigmoid(i) * np.tanh(g)
        h = _sigmoid(o) * np.tanh(c)
        a = V @ h + d
        return np.stack([h, c]), np.array([limits[0] * np.tanh(a[0]), limits[1] * _sigmoid(a[1])])


def size_of(inputs: int, hidden: int) -> int:
    """Return the number of parameters."""
    return 4 * hidden * (inputs + hidden + 1) + COMMANDS * (hidden + 1)


def unpacked(
    parameters: Float[np.ndarray, "n"], inputs: int, hidden: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return ``W (4 hidden, inputs + hidden)``, ``b``, ``V (2, hidden)``, ``d`` of a vector of parameters."""
    shapes = ((4 * hidden, inputs + hidden), (4 * hidden,), (COMMANDS, hidden), (COMMANDS,))
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    parts = np.split(parameters, ends[:-1])
    W, b, V, d = (part.reshape(shape) for part, shape in zip(parts, shapes, strict=True))
    return W, b, V, d


def read_inputs(scan: Float[np.ndarray, "beams"], inputs: int, longest: float) -> Float[np.ndarray, "inputs"]:
    """Return every so many-th range of a scan, m; ``longest`` where there is no reading."""
    if len(scan) % inputs:
        raise InputError("LSTM policy", "scan", f"a multiple of {inputs} readings; found {len(scan)}")
    taken = np.asarray(scan, np.float64)[:: len(scan) // inputs]
    return np.where(taken > 0.0, taken, longest)


def save_lstm(path: Path, policy: LstmPolicy) -> None:
    """Write a policy, whole or not at all."""
    header = {"format": LSTM_FORMAT, "version": LSTM_VERSION, "inputs": policy.inputs, "hidden": policy.hidden}
    text = json.dumps(header | {"trained": policy.trained}).encode()
    arrays = {name: np.asarray(getattr(policy, name), np.float32) for name in ("parameters", "mean", "std")}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(file, header=np.frombuffer(text, np.uint8), **arrays)  # type: ignore[arg-type]


def load_lstm(path: Path) -> LstmPolicy:
    """Read and check a policy.

    Raises:
        InputError: no such file, another format or version, or an array that does not fit.
    """
    expected = "an LSTM policy (.npz), as random search writes it"
    with open_npz(io.BytesIO(read_bytes(path, LSTM_BYTES, expected)), path, LSTM_BYTES, expected) as stored:
        header = stored.read_json("header", path)
        found = (header.get("format"), header.get("version")) if isinstance(header, dict) else (None, None)
        if found != (LSTM_FORMAT, LSTM_VERSION):
            raise InputError(path, "version", f"{LSTM_FORMAT} version {LSTM_VERSION}; found {found!r:.100}")
        sizes = [header.get(name) for name in ("inputs", "hidden")]
        if not all(type(size) is int and 1 <= size <= MOST_WIDE for size in sizes):
            raise InputError(path, "inputs", f"numbers of inputs and units up to {MOST_WIDE}; found {sizes!r:.100}")
        shapes = {"parameters": (size_of(*sizes),), "mean": (sizes[0],), "std": (sizes[0],)}
        for name, shape in shapes.items():
            if stored.shapes.get(name) != shape:
                raise InputError(path, name, f"float32 of shape {shape}; found {stored.shapes.get(name)}")
        trained = header.get("trained", {})
        if not isinstance(trained, dict):
            raise InputError(path, "trained", f"fields of the training; found {trained!r:.80}")
        given = {name: as_float32(stored.read(name), path, name, positive=name == "std") for name in shapes}
    parameters, mean, std = (given[name].astype(np.float64) for name in ("parameters", "mean", "std"))
    return LstmPolicy(sizes[0], sizes[1], parameters, mean, std, trained)


def _sigmoid(x: Any) -> Any:
    return 1.0 / (1.0 + np.exp(-x))
