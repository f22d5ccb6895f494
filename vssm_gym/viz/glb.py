"""Write a surface mesh as binary glTF 2.0 (GLB), for browsers, Blender and phones (Khronos, glTF 2.0 specification).

Positions stay in the map's frame, z up, in metres; the node's rotation turns them into glTF's frame, y up. Colours are
linear in glTF, and displayed without lighting: the map's colours already include it.
"""

import json
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from vssm_gym.files.atomic import atomic_write
from vssm_gym.viz.mesh import Mesh

_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125  # component types
_ARRAY, _ELEMENTS = 34962, 34963  # buffer targets
_HALF = 0.5**0.5  # cosine and sine of 45 degrees
Z_UP = [-_HALF, 0.0, 0.0, _HALF]  # quaternion (x, y, z, w): -90 degrees about x, (x, y, z) -> (x, z, -y)


def write_glb(path: Path, mesh: Mesh) -> None:
    """Write vertices, faces and colours atomically. An empty mesh is written as an empty scene."""
    parts = [
        mesh.vertices.astype("<f4").tobytes(),
        np.pad(linear(mesh.colours), ((0, 0), (0, 1)), constant_values=65535).astype("<u2").tobytes(),
        mesh.faces.astype("<u4").tobytes(),
    ]
    document = json.dumps(_document(mesh, [len(part) for part in parts]), separators=(",", ":")).encode()
    document += b" " * (-len(document) % 4)
    buffer = b"".join(parts)  # every part is a multiple of four bytes long
    chunks = struct.pack("<I4s", len(document), b"JSON") + document
    if buffer:
        chunks += struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    with atomic_write(path) as temporary:
        temporary.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def linear(colours: UInt8[np.ndarray, "vertices 3"]) -> UInt16[np.ndarray, "vertices 3"]:
    """Convert sRGB bytes to linear intensities, 65535 = 1 (IEC 61966-2-1)."""
    c: Float[np.ndarray, "vertices 3"] = colours / 255.0
    intensity = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return np.rint(65535.0 * intensity).astype(np.uint16)


def _document(mesh: Mesh, sizes: list[int]) -> dict:
    asset = {"version": "2.0", "generator": "vssm_gym"}
    if len(mesh.faces) == 0:
        return {"asset": asset, "scene": 0, "scenes": [{}]}
    low, high = (bound.tolist() for bound in (mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)))
    offsets = np.cumsum([0, *sizes]).tolist()
    targets = (_ARRAY, _ARRAY, _ELEMENTS)
    n = len(mesh.vertices)
    return {
        "asset": asset,
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "map", "mesh": 0, "rotation": Z_UP}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [
            {
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
                "doubleSided": True,
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "buffers": [{"byteLength": offsets[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": offset, "byteLength": size, "target": target}
            for offset, size, target in zip(offsets, sizes, targets, strict=False)
        ],
        "accessors": [
            {"bufferView": 0, "componentType": _FLOAT, "count": n, "type": "VEC3", "min": low, "max": high},
            {"bufferView": 1, "componentType": _UINT16, "normalized": True, "count": n, "type": "VEC4"},
            {"bufferView": 2, "componentType": _UINT32, "count": mesh.faces.size, "type": "SCALAR"},
        ],
    }
