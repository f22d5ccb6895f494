"""Embree's sixteen-ray packets, called from compiled code.

The wheel of embreex carries the whole Embree library but wraps only its single-ray call. This module opens that
library with ctypes and calls ``rtcIntersect16`` on coherent packets (neighbouring pixels): four times faster where the
processor has AVX-512, no slower elsewhere. Reaching into a wheel can break with a new version: :class:`PacketScene`
refuses what it does not know, and its user compares it with embreex.
"""

import ctypes
import weakref
from pathlib import Path

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

# From embree4/rtcore_*.h, stable within version 4.
_VERSION, _NATIVE_RAY4 = 0, 32  # RTCDeviceProperty; narrower processors cut a packet of 16 into parts
_ROBUST = 4  # RTCSceneFlags
_QUAD = 1  # RTCGeometryType
_INDEX, _VERTEX = 0, 1  # RTCBufferType
_FLOAT3, _UINT4 = 0x9003, 0x5004  # RTCFormat
_COHERENT = 1 << 16  # RTCRayQueryFlags
_NONE = 0xFFFFFFFF  # RTC_INVALID_GEOMETRY_ID; also: every ray mask, every feature
_WIDTH = 16  # rays of a packet
# RTCRayHit16: rows of 16 values. Ray: origin 0-2, near 3, direction 4-6, time 7, far 8, mask 9, id 10, flags 11.
# Hit: normal 12-14, u 15, v 16, primitive 17, geometry 18, instance 19, instance's primitive 20.
_ROWS = 21
_FACES = 6  # quads a box


def find_library(package: Path) -> Path:
    """The Embree library that an installed embreex package brought; raises OSError where it is not in its place."""
    folders = (package.parent / "embreex.libs", package / ".dylibs")  # wheels for Linux, macOS
    found = sorted(path for folder in folders for path in folder.glob("libembree4*"))
    if not found:
        raise OSError(f"no libembree4 beside {package}")
    return found[0]


class PacketScene:
    """Six quads a box in an Embree scene of its own.

    Args:
        library: the Embree library.
        vertices: ``(8 n, 3)`` float32 corners of ``n`` boxes, world frame, m.
        quads: ``(6 n, 4)`` uint32 indices into them, six in a row for each box.

    Raises OSError where the library is not an Embree 4 that traces packets.
    """

    def __init__(self, library: Path, vertices: np.ndarray, quads: np.ndarray) -> None:
        embree = ctypes.CDLL(str(library))
        pointer, number = ctypes.c_void_p, ctypes.c_int
        # Pointers are 64 bits wide; without its signature ctypes would cut them to an int's 32.
        signatures = {
            "rtcNewDevice": (pointer, [ctypes.c_char_p]),
            "rtcGetDeviceProperty": (ctypes.c_ssize_t, [pointer, number]),
            "rtcGetDeviceError": (number, [pointer]),
            "rtcReleaseDevice": (None, [pointer]),
            "rtcNewScene": (pointer, [pointer]),
            "rtcSetSceneFlags": (None, [pointer, number]),
            "rtcCommitScene": (None, [pointer]),
            "rtcReleaseScene": (None, [pointer]),
            "rtcNewGeometry": (pointer, [pointer, number]),
            "rtcSetNewGeometryBuffer": (
                pointer,
                [pointer, number, ctypes.c_uint, number, ctypes.c_size_t, ctypes.c_size_t],
            ),
            "rtcCommitGeometry": (None, [pointer]),
            "rtcAttachGeometry": (ctypes.c_uint, [pointer, pointer]),
            "rtcReleaseGeometry": (None, [pointer]),
            "rtcIntersect16": (None, [pointer, pointer, pointer, pointer]),
        }
        for name, (result, arguments) in signatures.items():
            try:
                function = getattr(embree, name)
            except AttributeError as error:
                raise OSError(f"{library} has no {name}") from error
            function.restype, function.argtypes = result, arguments

        device = embree.rtcNewDevice(b"threads=1")
        if not device:
            raise OSError(f"{library} gives no device")
        weakref.finalize(self, embree.rtcReleaseDevice, device)
        version = embree.rtcGetDeviceProperty(device, _VERSION)
        if version // 10000 != 4 or not embree.rtcGetDeviceProperty(device, _NATIVE_RAY4):
            raise OSError(f"Embree {version} traces no packets")
        scene = embree.rtcNewScene(device)
        weakref.finalize(self, embree.rtcReleaseScene, scene)
        embree.rtcSetSceneFlags(scene, _ROBUST)
        geometry = embree.rtcNewGeometry(device, _QUAD)
        for kind, layout, array in ((_VERTEX, _FLOAT3, vertices), (_INDEX, _UINT4, quads)):
            rows, stride = len(array), array.strides[0]
            ctypes.memmove(
                embree.rtcSetNewGeometryBuffer(geometry, kind, 0, layout, stride, rows), array.ctypes.data, array.nbytes
            )
        embree.rtcCommitGeometry(geometry)
        embree.rtcAttachGeometry(scene, geometry)
        embree.rtcReleaseGeometry(geometry)
        embree.rtcCommitScene(scene)
        if code := embree.rtcGetDeviceError(device):
            raise OSError(f"Embree reports error {code}")
        self._scene = scene
        self._intersect = ctypes.cast(embree.rtcIntersect16, pointer).value
        # RTCIntersectArguments: flags, features, then pointers that stay null.
        self._arguments = np.zeros(16, dtype=np.uint32)
        self._arguments[:2] = _COHERENT, _NONE

    def trace(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First hits of ``origin + t direction``: float32 ``t`` (0: none) and int32 box index (-1: none), ``(n,)``.

        Sixteen rays in a row make a packet: they should be neighbours. Several threads may call at once.
        """
        n = len(directions)
        t, box = np.empty(n, dtype=np.float32), np.empty(n, dtype=np.int32)
        packet, valid = _aligned(_ROWS * _WIDTH), _aligned(_WIDTH)
        _trace(
            self._intersect,
            self._scene,
            self._arguments.ctypes.data,
            origin.astype(np.float32),
            directions,
            packet.view(np.float32).reshape(_ROWS, _WIDTH),
            packet.reshape(_ROWS, _WIDTH),
            packet.ctypes.data,
            valid,
            valid.ctypes.data,
            t,
            box,
        )
        return t, box


def _aligned(size: int) -> np.ndarray:
    """Zeros, uint32 ``(size,)``, starting at a multiple of 64 bytes as Embree's packets must."""
    raw = np.zeros(4 * size + 64, dtype=np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + 4 * size].view(np.uint32)


@intrinsic
def _call(typingctx, function, a, b, c, d):
    """Call the C function at an address with four pointers; numba's own way to do so cannot be cached on disk."""
    # Only for its type: the address comes with the call. The C function returns nothing; nor does the word that is
    # read as its result mean anything.
    prototype = types.ExternalFunctionPointer(types.intp(*[types.intp] * 4), int)

    def generate(context, builder, signature, arguments):
        pointer = builder.inttoptr(arguments[0], context.get_value_type(prototype))
        return builder.call(pointer, arguments[1:])

    return types.intp(*[types.intp] * 5), generate


@numba.njit(nogil=True, cache=True)
def _trace(intersect, scene, args, origin, directions, rows, words, packet, valid, valid_address, t, box):
    """Fill packets with the rays, intersect, read the hits; ``rows`` and ``words`` are one memory, at ``packet``."""
    n = directions.shape[0]
    rows[3], rows[7] = 0.0, 0.0  # near end, time
    words[9], words[10], words[11] = _NONE, 0, 0  # mask, id, flags
    for axis in range(3):
        rows[axis] = origin[axis]
    for start in range(0, n, _WIDTH):
        count = min(_WIDTH, n - start)
        for j in range(_WIDTH):
            k = start + min(j, count - 1)
            valid[j] = _NONE if j < count else 0
            rows[4, j], rows[5, j], rows[6, j] = directions[k, 0], directions[k, 1], directions[k, 2]
            rows[8, j] = np.inf
            words[17, j], words[18, j], words[19, j], words[20, j] = _NONE, _NONE, _NONE, _NONE
        _call(intersect, valid_address, scene, packet, args)  # type: ignore[call-arg]
        for j in range(count):
            hit = words[17, j] != _NONE
            t[start + j] = rows[8, j] if hit else np.float32(0.0)
            box[start + j] = np.int32(words[17, j] // _FACES) if hit else np.int32(-1)
