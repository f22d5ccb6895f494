"""Write the inputs that once cost minutes, gigabytes or a traceback, and their like."""

import gzip
import io
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.fuzz.mutations import NASTY

Case = tuple[str, Callable[[Path], None]]  # of which reader, and what changes a valid input in its folder


def _text(name: str, content: str | bytes) -> Callable[[Path], None]:
    data = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / name).write_bytes(data) and None


def _mjcf(body: str) -> Callable[[Path], None]:
    return _text("scene.xml", f'<mujoco><worldbody><geom type="plane" size="5 5 .1"/>{body}</worldbody></mujoco>')


def _nested(times: int, count: str, inner: str) -> str:
    return f'<replicate count="{count}" offset=".1 0 0">' * times + inner + "</replicate>" * times


def _plan(corners: np.ndarray) -> Callable[[Path], None]:
    return _text("plan.json", json.dumps({"verts": corners.tolist(), "room_category": {}}))


def _star(points: int, inner: float = 5.0) -> np.ndarray:
    angle = np.linspace(0.0, 2.0 * np.pi, 2 * points, endpoint=False)
    radius = np.where(np.arange(2 * points) % 2, 20.0, inner)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def _comb(teeth: int) -> np.ndarray:
    width = 40.0 / teeth
    rows = [[(x, 0), (x, 5), (x + width / 2, 5), (x + width / 2, 0)] for x in width * np.arange(teeth)]
    return np.array([*(corner for row in rows for corner in row), (40.0, 0.0), (40.0, -5.0), (0.0, -5.0)])


def _changed_npz(name: str, **changes: object) -> Callable[[Path], None]:
    """Return what changes fields of the header and arrays (by their names) of a ``.npz``."""

    def change(folder: Path) -> None:
        with np.load(folder / name, allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in stored.files}
        header = json.loads(arrays.pop("header").tobytes())
        header |= {key: value for key, value in changes.items() if key not in arrays}
        arrays |= {key: value for key, value in changes.items() if key in arrays}  # type: ignore[misc]
        text = np.frombuffer(json.dumps(header).encode(), np.uint8)
        np.savez_compressed(folder / name, header=text, **arrays)  # type: ignore[arg-type]

    return change


def _bomb(name: str, array: str, size: int) -> Callable[[Path], None]:
    """Return what replaces an array by ``size`` zeros, a thousand times smaller when packed."""

    def change(folder: Path) -> None:
        with np.load(folder / name, allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in stored.files if key != array}
        np.savez_compressed(folder / name, **arrays)
        head = io.BytesIO()
        np.lib.format.write_array_header_1_0(head, {"descr": "|u1", "fortran_order": False, "shape": (size,)})
        with (
            zipfile.ZipFile(folder / name, "a", zipfile.ZIP_DEFLATED) as archive,
            archive.open(f"{array}.npy", "w", force_zip64=True) as member,
        ):
            member.write(head.getvalue())
            for _ in range(size // 10_000_000):
                member.write(bytes(10_000_000))

    return change


def _flipped(name: str, method: int | None = None, encrypted: bool = False) -> Callable[[Path], None]:
    """Return what declares another compression or encryption of every member, or flips a bit of packed data."""

    def change(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        if method is None and not encrypted:
            data[60] ^= 4
        start = 0
        while method is not None or encrypted:
            start = data.find(b"PK\x01\x02", start)
            if start < 0:
                break
            if method is not None:
                data[start + 10 : start + 12] = struct.pack("<H", method)
            data[start + 8] |= encrypted
            start += 4
        (folder / name).write_bytes(bytes(data))

    return change


def _array_header(name: str, text: str) -> Callable[[Path], None]:
    """Return what replaces the header of a policy's first weight."""

    def change(folder: Path) -> None:
        head = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()
        with zipfile.ZipFile(folder / name, "w") as archive:
            archive.writestr("weight0.npy", head)
            archive.writestr("header.npy", head)

    return change


def _png(width: int, height: int) -> bytes:
    """Return a grey PNG of one colour; a gigapixel of it packs to a megabyte."""
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    packer, row = zlib.compressobj(9), bytes(width + 1)
    rows = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def _packed(name: str, content: bytes, times: int) -> Callable[[Path], None]:
    """Return what writes a gzip file of ``content`` repeated."""
    return lambda folder: (folder / name).write_bytes(gzip.compress(content * times)) and None


def _images(side: int, only: str = "") -> Callable[[Path], None]:
    """Return what replaces images by a square one of ``side`` pixels."""

    def change(folder: Path) -> None:
        content = _png(side, side)
        for path in folder.rglob("*.png"):
            if only in str(path):
                path.write_bytes(content)

    return change


def _dense_stamps(folder: Path) -> None:
    (folder / "sequence" / "associations.txt").unlink()
    for kind in ("rgb", "depth"):
        image = next((folder / "sequence" / kind).iterdir()).name
        rows = (f"{1e-6 * i:.7f} {kind}/{image}\n" for i in range(20_000))
        (folder / "sequence" / f"{kind}.txt").write_text("".join(rows))


def _pipe(name: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).unlink()
        os.mkfifo(folder / name)

    return change


def _camera(**changes: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "sequence" / "camera.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


def _episode(**changes: object) -> Callable[[Path], None]:
    """Return what changes fields of the third of Habitat's episodes."""

    def change(folder: Path) -> None:
        content = json.loads((folder / "val.json").read_text())
        content["episodes"][2] |= changes
        (folder / "val.json").write_text(json.dumps(content))

    return change


GEOM, CUBE = '<geom size=".1"/>', '<geom type="box" size=".1 .1 .1" pos="1 1 1"/>'
MJCF = [
    *(_nested(k, "100", inner) for k, inner in ((5, ""), (4, "<body/>"), (60, ""), (3, GEOM))),
    *(_nested(1, count, GEOM) for count in ("²", "-1", "1e9", "9" * 400, "", "4999")),
    *("<body/>" * 49_000, "<frame/>" * 49_000, CUBE * 9900, '<geom size="1000"/>'),
]
PLANS = [_comb(160), _comb(2000), _star(150), _star(490), _star(500, 20.0)]
BOXES = {"verts": [[0, 0], [9, 0], [9, 9]], "room_category": {"a": [[0, 0, 1, 1]] * 99_999}}
SLOTS = (10**8, 10**300, -1, 0.5, "9", None, True)
BLOCKS = ([10**6] * 3, [10**9, 1, 1], [10**400, 1, 1], [0, 1, 1])
ARRAY_HEADERS = [
    "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': " + "(" * 5000,
    "{'descr': '<f4', 'fortran_order': False, 'shape': (True,)}",
    "{'descr': [('a', '<f4', " + "(" * 3000,
    "\\",
]
PIPES = ("rgb.txt", "associations.txt", "controls.txt", "camera.json", "imu.txt", "groundtruth.txt")
IDENTITY = np.eye(4)
MOUNTS = [(0.0 * IDENTITY).tolist(), (2.0 * IDENTITY).tolist(), (-IDENTITY).tolist(), IDENTITY[:3].tolist()]
TASKS = ("2001-99-99", "10000000000", "0-9999999999", "0b_", "0-²", "1e400", ".inf", "[1.5]", "-5")
NAMES = ('"a\\0b"', "x" * 300, "x" * 5000)
YAMLS = ("[" * 100_000, "- " * 100_000, "a: &a [1]\nb: [*a, *a]", "? " * 5000)
TURNS = ([0, 0, 0, 0], [0, 1e200, 0, 1e200], [10**400] * 4, [0, 0, 0], [1, 0, 0, 0], None, ["0"] * 4, [[0], 0, 0, 1])
PLACES = ([1e300, 0, 0], [1e4, 0, 0], [-1e4, 1e4, -1e4], [0.0], None, [True, 0, 0])
DEEP = ("[" * 3000 + "]" * 3000, '{"a":' * 3000 + "1" + "}" * 3000, "[" + "[]," * 4_000_000 + "1]", "9" * 5000)
CONTROLS = ("0 nan 0 0\n", "0 inf 0 0\n", "0 1e999 0 0\n", "0 0 0 0\n" * 1_000_000)
POSES = ("0 1e300 0 0 0 0 0 1\n", "9" * 400 + " 0 0 0 0 0 0 1\n", "1 0 0 0 0 0 0 1\n" * 700_000)

CHEAP: list[Case] = [
    *(("mjcf", _mjcf(body)) for body in MJCF),
    *(("houseexpo", _plan(corners)) for corners in PLANS),
    ("houseexpo", _text("plan.json", json.dumps(BOXES))),
    *(("sparse map", _changed_npz("map.npz", slots=slots)) for slots in SLOTS),
    *(("map", _changed_npz("map.npz", blocks=blocks)) for blocks in BLOCKS),
    ("map", _changed_npz("map.npz", voxel_size=np.float64(1e-300))),
    ("map", _changed_npz("map.npz", origin=np.full(3, 1e300))),
    *(("policy", _flipped("policy.npz", method)) for method in (None, 12, 14, 99, 9)),
    ("policy", _flipped("policy.npz", encrypted=True)),
    *(("policy", _array_header("policy.npz", text)) for text in ARRAY_HEADERS),
    ("sequence", _dense_stamps),
    *(("habitat", _episode(start_rotation=turn)) for turn in TURNS),
    *(("habitat", _episode(start_position=place)) for place in PLACES),
    *(("habitat", _episode(goals=goals)) for goals in ([], [{}] * 2, [{"position": [1e4, 0, 0]}], [None], {})),
    *(("habitat", _text("val.json", content)) for content in NASTY),
    *(("sequence", _pipe(f"sequence/{name}")) for name in PIPES),
    *(("sequence", _camera(T_body_cam=T)) for T in MOUNTS),
    *(("sequence", _camera(distortion=[0, 0, 0, 0, k])) for k in (1e300, float("inf"), 10**400)),
    *(("sequence", _camera(width=value)) for value in (float("inf"), 10**400, 1e9, -1, "16")),
    *(("sequence", _text("sequence/controls.txt", lines)) for lines in CONTROLS),
    *(("sequence", _text("sequence/associations.txt", f"0 {at} 0 {at}\n")) for at in ("../../x.png", "/etc/passwd")),
    *(("trajectory", _text("poses.txt", lines)) for lines in POSES),
    *(("sweep", _text("sweep.yaml", f"scenes: oak\nagents: astar\ntasks: {value}\n")) for value in TASKS),
    *(("sweep", _text("sweep.yaml", f"scenes: {name}\nagents: astar\ntasks: 1\n")) for name in NAMES),
    *(("sweep", _text("sweep.yaml", text)) for text in YAMLS),
    *(("training", _text("training.yaml", f"name: a\nsteps: {value}\n")) for value in (*TASKS, "9" * 5000)),
    *((reader, _text(f"{reader}.json", text)) for reader in ("scene", "tasks") for text in DEEP),
    *(("scene", _text("scene.json", content)) for content in NASTY),
    *(("trajectory", _text("poses.txt", content)) for content in NASTY),
    *(("sweep", _text("sweep.yaml", content)) for content in NASTY),
    *(("episode log", _text("episodes.jsonl", content + b"\n")) for content in NASTY),
]
COSTLY: list[Case] = [  # to make: gigabytes of zeros are packed
    ("habitat, packed", _packed("val.json.gz", b" ", 10**9)),
    *(("procthor", _packed("houses.jsonl.gz", part, 10**8)) for part in (b"\n", b"   ")),
    ("ros map", _images(30_000)),
    *(("map", _bomb("map.npz", name, 3_000_000_000)) for name in ("occupancy", "header")),
    ("map", _bomb("map.npz", "colour", 900_000_000)),
    *(("sequence", _images(20_000, only)) for only in ("", "depth")),
]
SPECIAL = CHEAP + COSTLY
