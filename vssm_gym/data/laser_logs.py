"""Read and write logs of a planar laser scanner: scans and odometry, with relations and poses for a judge.

Two forms of text are read, both with or without gzip:

    graph    ROBOTLASER1 scans; the EDGE2 relations between consecutive scans are the odometry, those between others are
             loops; VERTEX2 poses. Poses and loops are what others found: for a judge, not for inference
    CARMEN   FLASER scans with the odometry's pose, or ROBOTLASER1 with ODOM lines or the poses of its own

    EDGE2 a b dx dy dturn ...          pose b seen from pose a
    ROBOTLASER1 type start fov step max_range accuracy mode n r_1 ... r_n m e_1 ... e_m laser robot ...
    FLASER n r_1 ... r_n laser odometry time host time
    ODOM odometry speed turn_rate acceleration time host time

where laser, robot and odometry are poses, x y heading. A graph's scans repeat its corrected poses; of them only
the pose of the scanner on the robot is read.
"""

import gzip
import io
import math
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.bounded import check_lines, read_bytes
from vssm_gym.files.numbers import LARGEST_NUMBER
from vssm_gym.geometry.planar_poses import compose, relation

SCAN_LOG_BYTES = 256 << 20  # of a log, unpacked
SCAN_LOG_LINES = 2_000_000  # a day at 20 scans a second
MOST_READINGS = 10_000  # of a scan
FLASER_FIELD_OF_VIEW = math.pi  # rad: the form has no field for it
FLASER_RANGE = 80.0  # m: at and beyond it a scanner of such a log has not measured
GZIP = b"\x1f\x8b"


@dataclass(frozen=True)
class LaserLog:
    """Hold the scans of one drive; lengths in m, angles in rad.

    Attributes:
        ranges: of each scan, 0 where there is no reading.
        angles: of the readings on the robot, counter-clockwise from ahead.
        max_range: above all readings.
        mount: the scanner's pose on the robot: forward, left, turn.
        motions: pose of the robot at a scan, seen from the scan before, by the odometry: forward, left, turn.
        poses: x, y, heading at each scan as others found them, or the true ones of a simulation; for a judge. None:
            the log has none.
        loops: numbers of two scans each whose relation is known; for a judge.
        relations: pose at the second scan of a loop, seen from the first.
    """

    ranges: Float[np.ndarray, "scans beams"]
    angles: Float[np.ndarray, "beams"]
    max_range: float
    mount: Float[np.ndarray, "3"]
    motions: Float[np.ndarray, "motions 3"]
    poses: Float[np.ndarray, "scans 3"] | None
    loops: Int[np.ndarray, "loops 2"]
    relations: Float[np.ndarray, "loops 3"]

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self.ranges)

    def path(self) -> Float[np.ndarray, "scans 3"]:
        """Return the poses by the odometry alone, from the origin: path integration."""
        return integrated(self.motions)

    def part(self, first: int, last: int) -> "LaserLog":
        """Return the scans from ``first`` to before ``last``, and the loops among them."""
        within = np.all((self.loops >= first) & (self.loops < last), axis=1)
        poses = None if self.poses is None else self.poses[first:last]
        scans, motions = self.ranges[first:last], self.motions[first : last - 1]
        found = self.loops[within] - first, self.relations[within]
        return LaserLog(scans, self.angles, self.max_range, self.mount, motions, poses, *found)


def integrated(motions: Float[np.ndarray, "motions 3"]) -> Float[np.ndarray, "motions+1 3"]:
    """Return the poses that motions (forward, left, turn) lead to one after the other, from the origin on."""
    poses = np.zeros((len(motions) + 1, 3))
    for t, motion in enumerate(motions):
        poses[t + 1] = compose(poses[t], motion)
    return poses


def read_laser_log(path: str | Path) -> LaserLog:
    """Read a log of either form.

    Raises:
        InputError: a missing or damaged file, no scan, scans that differ in their readings, a scan without odometry.
    """
    path = Path(path)
    scans, odometry, graph = _parsed(path)
    if not scans:
        raise InputError(path, "file", "lines ROBOTLASER1 or FLASER, one for each scan; found none")
    first = scans[0]
    for scan in scans[1:]:
        if len(scan.ranges) != len(first.ranges) or not np.allclose(scan.angles, first.angles, atol=1e-6):
            expected = f"{len(first.ranges)} readings at the angles of the first scan; found {len(scan.ranges)}"
            raise InputError(path, f"line {scan.line}", expected)
    mounts = np.array([relation(scan.robot, scan.laser) for scan in scans])
    poses, loops, relations = None, np.zeros((0, 2), int), np.zeros((0, 3))
    if graph.edges:
        motions, loops, relations = _of_graph(path, graph, len(scans))
        poses = _poses(path, graph, len(scans))
    else:
        at = _odometry_at_scans(scans, odometry)
        motions = relation(at[:-1], at[1:])
    ranges = np.array([scan.ranges for scan in scans], np.float32)
    mount = np.median(mounts, axis=0).round(4)
    return LaserLog(ranges, first.angles, first.max_range, mount, motions, poses, loops, relations)


def write_laser_log(path: str | Path, log: LaserLog) -> None:
    """Write a log as a graph, its poses as VERTEX2; the file is complete or absent."""
    step = float(log.angles[1] - log.angles[0]) if len(log.angles) > 1 else 0.0
    head = f"0 {log.angles[0]:.9f} {step * len(log.angles):.9f} {step:.9f} {log.max_range:g} 0 0 {len(log.angles)}"
    mount = " ".join(f"{value:.6f}" for value in log.mount)
    with atomic_write(Path(path)) as temporary, temporary.open("w") as file:
        for t, ranges in enumerate(log.ranges):
            if log.poses is not None:
                file.write(f"VERTEX2 {t} {_words(log.poses[t])}\n")
            file.write(
                f"ROBOTLASER1 {head} {' '.join(f'{r:.5f}' for r in ranges)} 0 {mount} 0 0 0 0 0 0 0 0 {t} - {t}\n"
            )
        edges = [(t, t + 1, motion) for t, motion in enumerate(log.motions)]
        edges += [(a, b, between) for (a, b), between in zip(log.loops, log.relations, strict=True)]
        file.writelines(f"EDGE2 {a} {b} {_words(motion)}\n" for a, b, motion in edges)


def _words(values: np.ndarray) -> str:
    return " ".join(f"{value:.9f}" for value in values)


@dataclass
class _Scan:
    line: int
    ranges: np.ndarray
    angles: np.ndarray
    max_range: float
    laser: np.ndarray
    robot: np.ndarray
    own: bool  # whether the robot's pose is that of the odometry by its form


@dataclass
class _Graph:
    vertices: dict[int, np.ndarray]
    edges: list[tuple[int, int, int, np.ndarray]]  # line, from, to, relation


def _parsed(path: Path) -> tuple[list[_Scan], list[tuple[int, np.ndarray]], _Graph]:
    """Return the scans, the poses of ODOM lines with their numbers, and the graph."""
    scans: list[_Scan] = []
    odometry: list[tuple[int, np.ndarray]] = []
    graph = _Graph({}, [])
    for number, line in enumerate(io.StringIO(_text(path)), 1):
        words = line.split()
        if not words:
            continue
        try:
            if words[0] == "ROBOTLASER1":
                scans.append(_robot_laser(number, words))
            elif words[0] == "FLASER":
                scans.append(_front_laser(number, words))
            elif words[0] == "ODOM":
                odometry.append((number, _numbers(words[1:4], 3)))
            elif words[0] == "VERTEX2":
                graph.vertices[int(words[1])] = _numbers(words[2:5], 3)
            elif words[0] == "EDGE2":
                graph.edges.append((number, int(words[1]), int(words[2]), _numbers(words[3:6], 3)))
        except (ValueError, IndexError):
            raise InputError(path, f"line {number}", f"the fields of {words[0]}, finite numbers") from None
    return scans, odometry, graph


def _text(path: Path) -> str:
    content = read_bytes(path, SCAN_LOG_BYTES, "a laser log (CARMEN or graph, text or gzip)")
    if content[:2] == GZIP:
        try:
            with gzip.open(io.BytesIO(content)) as file:
                content = file.read(SCAN_LOG_BYTES + 1)
        except (OSError, EOFError, zlib.error):
            raise InputError(path, "file", "a complete gzip file") from None
        if len(content) > SCAN_LOG_BYTES:
            raise InputError(path, "file", f"at most {SCAN_LOG_BYTES:,} bytes, unpacked")
    check_lines(content, SCAN_LOG_LINES, path)
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(path, "file", "text, in UTF-8") from error


def _numbers(words: list[str], count: int) -> np.ndarray:
    values = np.array([float(word) for word in words])
    if len(values) != count or not (np.abs(values) <= LARGEST_NUMBER).all():
        raise ValueError
    return values


def _count(word: str) -> int:
    count = int(word)
    if not 1 <= count <= MOST_READINGS:
        raise ValueError
    return count


def _robot_laser(number: int, words: list[str]) -> _Scan:
    start, _, step, max_range = _numbers(words[2:6], 4)
    count = _count(words[8])
    after = 9 + count
    after += 1 + int(words[after])  # remissions
    laser, robot = _numbers(words[after : after + 3], 3), _numbers(words[after + 3 : after + 6], 3)
    angles = start + step * np.arange(count)
    return _Scan(number, _measured(words[9 : 9 + count], max_range), angles, float(max_range), laser, robot, False)


def _front_laser(number: int, words: list[str]) -> _Scan:
    count = _count(words[1])
    robot = _numbers(words[5 + count : 8 + count], 3)
    between = count - 1 if count % 2 else count  # 181 readings include both ends
    angles = FLASER_FIELD_OF_VIEW * (np.arange(count) / between - 0.5)
    # Corrected logs have the corrected pose as the laser's: the scanner is where the odometry has the robot.
    return _Scan(number, _measured(words[2 : 2 + count], FLASER_RANGE), angles, FLASER_RANGE, robot, robot, True)


def _measured(words: list[str], max_range: float) -> np.ndarray:
    """Return ranges, 0 where there is no reading."""
    ranges = np.array([float(word) for word in words])
    return np.where((ranges > 0.0) & (ranges < max_range), ranges, 0.0)


def _of_graph(path: Path, graph: _Graph, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the motions between consecutive scans, and the loops with their relations."""
    motions: list[np.ndarray | None] = [None] * (count - 1)
    loops, relations = [], []
    for number, a, b, between in graph.edges:
        if not (0 <= a < count and 0 <= b < count and a != b):
            raise InputError(path, f"line {number}", f"numbers of two of the {count} scans; found {a} and {b}")
        if b == a + 1 and motions[a] is None:
            motions[a] = between
        else:
            loops.append((a, b))
            relations.append(between)
    for t, motion in enumerate(motions):
        if motion is None:
            raise InputError(path, "EDGE2", f"one from each scan to the next; none from {t} to {t + 1}")
    return np.array(motions).reshape(-1, 3), np.array(loops, int).reshape(-1, 2), np.array(relations).reshape(-1, 3)


def _poses(path: Path, graph: _Graph, count: int) -> np.ndarray | None:
    if not graph.vertices:
        return None
    missing = next((t for t in range(count) if t not in graph.vertices), None)
    if missing is not None:
        raise InputError(path, "VERTEX2", f"one for each scan, or none; scan {missing} has none")
    return np.array([graph.vertices[t] for t in range(count)])


def _odometry_at_scans(scans: list[_Scan], odometry: list[tuple[int, np.ndarray]]) -> np.ndarray:
    """Return the odometry's pose at each scan: its own, or that of the last ODOM line before it."""
    if not odometry or scans[0].own:
        return np.array([scan.robot for scan in scans])
    lines = np.array([line for line, _ in odometry])
    last = np.maximum(np.searchsorted(lines, [scan.line for scan in scans]) - 1, 0)
    return np.array([pose for _, pose in odometry])[last]
