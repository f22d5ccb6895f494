"""Damage one file of an input: its bytes, its words, its JSON, or the arrays of its ``.npz``; all from one seed."""

import copy
import gzip
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from tests.helpers.damage import VALUES

NASTY = [
    *(b"\0", b"nan", b"1e999", b"-", b"9" * 400, b"<!DOCTYPE a>", b"&a;", b"*a", b"\xff\xfe", b"[" * 3000, b"{" * 3000),
    *(b"../../x", b"/etc/passwd", b"true", b"\xe2\x80\xae", b"\x1b[31m", b"1e-300", b"0x10", b"0b_", b"2001-99-99"),
    *(b"!!python/object/apply:os.system [ls]", b"<script>", b"x" * 5000, b"\xc2\xb2", b"inf", b"\n", b"\r\n", b"#"),
]  # fmt: skip


def mutate(folder: Path, rng: np.random.Generator) -> str:
    """Damage one to three times; return which files were damaged and how."""
    said = []
    for _ in range(_pick(rng, (1, 1, 1, 2, 3))):  # one damage is refused late, or not at all
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        if not files:
            break
        path = files[int(rng.integers(len(files)))]
        content = path.read_bytes()
        ways = ["bytes", "words", *WAYS.get(path.suffix, ["words"] * 2)]
        way = ways[int(rng.integers(len(ways)))]
        try:
            damaged = MUTATIONS[way](content, rng)
        except Exception:  # damaged before: it is no JSON or archive any more, which libraries say in many ways
            damaged = _bytes(content, rng)
        path.write_bytes(damaged)
        said.append(f"{path.relative_to(folder)} ({way})")
    return ", ".join(said)


def _pick(rng: np.random.Generator, items: Any) -> Any:
    return items[int(rng.integers(len(items)))]


def _bytes(content: bytes, rng: np.random.Generator) -> bytes:
    a, b = sorted(int(k) for k in rng.integers(0, len(content) + 1, 2))
    b = min(b, a + 100_000)
    match _pick(rng, ("cut", "end", "flip", "overwrite", "repeat", "insert")):
        case "cut":
            return content[:a] + content[b:]
        case "end":
            return content[:a]
        case "flip":
            damaged = bytearray(content)
            for k in rng.integers(0, max(len(content), 1), 4 if content else 0):
                damaged[k] ^= 1 << int(rng.integers(8))
            return bytes(damaged)
        case "overwrite":
            return content[:a] + rng.bytes(8) + content[a + 8 :]
        case "repeat":
            return content[:b] + content[a:b] + content[b:]
        case _:
            return content[:a] + _pick(rng, NASTY) + content[a:]


def _words(content: bytes, rng: np.random.Generator) -> bytes:
    """Replace, remove or repeat a word or a line."""
    separator = _pick(rng, (b" ", b"\n", b",", b'"', b":"))
    words = content.split(separator)
    k = int(rng.integers(len(words)))
    match _pick(rng, ("replace", "replace", "remove", "repeat", "swap")):
        case "replace":
            words[k] = _pick(rng, NASTY)
        case "remove":
            del words[k]
        case "repeat":
            words[k:k] = [words[k]] * int(_pick(rng, (1, 2, 50)))
        case _:
            m = int(rng.integers(len(words)))
            words[k], words[m] = words[m], words[k]
    return separator.join(words)


def _json(content: bytes, rng: np.random.Generator) -> bytes:
    """Remove a part of a JSON text, or of one of its lines, replace it by nonsense, or copy another part over it."""
    lines = content.splitlines()
    number = int(rng.integers(len(lines)))
    try:
        data, of_line = json.loads(content), False
    except json.JSONDecodeError:
        data, of_line = json.loads(lines[number]), True
    holder = {"": data}
    path = _path(holder, rng)
    parent: Any = holder
    for key in path[:-1]:
        parent = parent[key]
    kind = _pick(rng, ("remove", "value", "value", "number", "copy", "add"))
    if kind == "remove" and len(path) > 1:
        del parent[path[-1]]
    elif kind == "number":
        parent[path[-1]] = float(rng.uniform(-200.0, 200.0))
    elif kind == "copy":
        value: Any = holder
        for key in _path(holder, rng):
            value = value[key]
        parent[path[-1]] = copy.deepcopy(value)
    elif kind == "add" and isinstance(parent[path[-1]], dict):
        parent[path[-1]]["unknown"] = 1
    else:
        parent[path[-1]] = _pick(rng, VALUES)
    text = json.dumps(holder[""]).encode()
    return b"\n".join([*lines[:number], text, *lines[number + 1 :]]) + b"\n" if of_line else text


def _path(data: Any, rng: np.random.Generator) -> list[Any]:
    """Return the keys to a part of ``data``, deeper parts being as likely as their parents together."""
    path: list[Any] = [""]
    value = data[""]
    while isinstance(value, dict | list) and value and rng.random() < 0.8:
        path.append(_pick(rng, sorted(value) if isinstance(value, dict) else range(len(value))))
        value = value[path[-1]]
    return path


def _npz(content: bytes, rng: np.random.Generator) -> bytes:
    """Change an array's values, type or shape, its header's JSON, or take it out; write the rest as it was."""
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        arrays: dict[str, Any] = {name: stored[name] for name in stored.files}
    name = _pick(rng, sorted(arrays))
    array = arrays[name]
    if name == "header":
        arrays[name] = np.frombuffer(_json(array.tobytes(), rng), np.uint8)
    else:
        match _pick(rng, ("values", "type", "shape", "grow", "remove", "objects")):
            case "values":
                flat = array.reshape(-1).copy()
                value = _pick(rng, (np.nan, np.inf, -1.0, 0.0, 1e300, 1e-300))
                flat[rng.integers(0, max(flat.size, 1), 3 if flat.size else 0)] = (
                    value if flat.dtype.kind == "f" else -1
                )
                arrays[name] = flat.reshape(array.shape)
            case "type":
                arrays[name] = array.astype(_pick(rng, ("f8", "i4", "U3", "?", "c8", ">f4")))
            case "shape":
                arrays[name] = array.reshape(-1)[: int(rng.integers(array.size + 1))]
            case "grow":
                arrays[name] = np.zeros((3, *array.shape), array.dtype)
            case "remove":
                del arrays[name]
            case _:
                arrays[name] = np.array([{}, None], dtype=object)
    file = io.BytesIO()
    (np.savez_compressed if rng.random() < 0.5 else np.savez)(file, **arrays)
    return file.getvalue()


def _gz(content: bytes, rng: np.random.Generator) -> bytes:
    """Damage what is packed."""
    return gzip.compress(_pick(rng, (_json, _json, _words))(gzip.decompress(content), rng))


MUTATIONS = {"bytes": _bytes, "words": _words, "json": _json, "npz": _npz, "gz": _gz}
WAYS = {".json": ["json"] * 6, ".npz": ["npz"] * 6, ".jsonl": ["json"] * 4, ".gz": ["gz"] * 6}  # beside bytes and words
