"""Test laser logs: round trips, both forms by hand, what is read for a judge alone, clear errors for bad files."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.data.laser_logs import LaserLog, read_laser_log, write_laser_log
from vssm_gym.errors import InputError
from vssm_gym.geometry.planar_poses import compose, relation

poses = st.tuples(*[st.floats(-50.0, 50.0)] * 2, st.floats(-3.1, 3.1)).map(np.array)

GRAPH = """VERTEX2 0 4.78 -5.84 -1.69
ROBOTLASER1 0 -1.5707963 3.1415927 1.5707963 50.0 0.1 0 3 81.83 3.36 3.34 0 0.96 2 0 1.0 2 0 0 0 0 0 0 9.5 host 0.1
VERTEX2 1 5.0 -5.0 0.0
ROBOTLASER1 0 -1.5707963 3.1415927 1.5707963 50.0 0.1 0 3 1.0 2.0 3.0 0 4.96 -5.0 0 5.0 -5.0 0 0 0 0 0 0 9.7 host 0.3
VERTEX2 2 6.0 -5.0 0.0
ROBOTLASER1 0 -1.5707963 3.1415927 1.5707963 50.0 0.1 0 3 0.0 2.0 3.0 1 5 5.96 -5.0 0 6.0 -5.0 0 0 0 0 0 0 9.9 host 0.5
# loops come after the odometry
EDGE2 0 1 1.0 0.1 0.5 100 0 100 500 0 0
EDGE2 1 2 1.0 0.0 -0.5 100 0 100 500 0 0
EDGE2 0 2 2.0 0.2 0.1 100 0 100 500 0 0
"""

CARMEN = """PARAM robot_width 0.4
ODOM 1.0 1.0 0.0 0 0 0 1.0 host 1.0
FLASER 3 2.0 80.0 1.0 9.0 9.0 9.0 1.0 2.0 0.5 1.1 host 1.1
ODOM 7.0 7.0 0.0 0 0 0 1.2 host 1.2
FLASER 3 1.0 1.0 1.0 9.0 9.0 9.0 2.0 2.0 1.0 1.3 host 1.3
"""


def written(folder: Path, text: str) -> Path:
    (folder / "drive.log").write_text(text)
    return folder / "drive.log"


def random_log(seed: int, scans: int, beams: int, judged: bool) -> LaserLog:
    rng = np.random.default_rng(seed)
    ranges = np.where(rng.random((scans, beams)) < 0.2, 0.0, rng.uniform(0.1, 9.0, (scans, beams)))
    loops = rng.integers(0, scans, (4 if judged else 0, 2))
    loops = loops[(loops[:, 0] != loops[:, 1]) & (loops[:, 1] != loops[:, 0] + 1)]
    triples = lambda n: rng.uniform(-3.0, 3.0, (n, 3))
    angles = np.linspace(-1.5, 1.5, beams)
    judge = triples(scans) if judged else None
    return LaserLog(
        ranges.astype(np.float32), angles, 10.0, triples(1)[0], triples(scans - 1), judge, loops, triples(len(loops))
    )


@given(poses, poses)
def test_composition_and_relation_are_inverse(pose, other):
    np.testing.assert_allclose(compose(pose, relation(pose, other))[:2], other[:2], atol=1e-4)
    np.testing.assert_allclose(relation(pose, compose(pose, np.zeros(3))), 0.0, atol=1e-6)


@given(st.integers(0, 2**32 - 1), st.integers(2, 9), st.integers(2, 7), st.booleans())
def test_a_log_that_is_written_is_read(tmp_path_factory, seed, scans, beams, judged):
    log, path = random_log(seed, scans, beams, judged), tmp_path_factory.mktemp("log") / "drive.log"
    write_laser_log(path, log)
    read = read_laser_log(path)
    np.testing.assert_allclose(read.ranges, log.ranges, atol=1e-5)
    for name in ("angles", "mount", "motions", "relations"):
        np.testing.assert_allclose(getattr(read, name), getattr(log, name), atol=1e-4, err_msg=name)
    np.testing.assert_array_equal(read.loops, log.loops)
    assert (read.poses is None) == (log.poses is None) and read.max_range == log.max_range


def test_a_graph_by_hand(tmp_path):
    """Ranges beyond the largest are no readings; the scanner is 4 cm behind the robot's origin; one edge is a loop."""
    log = read_laser_log(written(tmp_path, GRAPH))
    np.testing.assert_allclose(log.ranges, [[0.0, 3.36, 3.34], [1.0, 2.0, 3.0], [0.0, 2.0, 3.0]], rtol=1e-6)
    np.testing.assert_allclose(log.angles, [-np.pi / 2.0, 0.0, np.pi / 2.0], atol=1e-6)
    np.testing.assert_allclose(log.motions, [[1.0, 0.1, 0.5], [1.0, 0.0, -0.5]])
    np.testing.assert_allclose(log.mount, [-0.04, 0.0, 0.0], atol=1e-3)
    np.testing.assert_array_equal(log.loops, [[0, 2]])
    assert log.poses is not None and log.poses[1].tolist() == [5.0, -5.0, 0.0]
    np.testing.assert_allclose(log.path()[2], [1.0 + np.cos(0.5), 0.1 + np.sin(0.5), 0.0], atol=1e-6)


def test_what_a_graph_was_corrected_to_does_not_matter(tmp_path):
    """Other vertices and other poses in the scans leave what inference reads as it is."""
    before = read_laser_log(written(tmp_path, GRAPH))
    moved = GRAPH.replace("VERTEX2 1 5.0 -5.0 0.0", "VERTEX2 1 9.0 9.0 1.0").replace(
        "0 4.96 -5.0 0 5.0 -5.0 0", "0 8.96 9.0 0 9.0 9.0 0"
    )
    after = read_laser_log(written(tmp_path, moved))
    for name in ("ranges", "angles", "motions", "mount"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    assert not np.array_equal(after.poses, before.poses)


def test_carmen_by_hand(tmp_path):
    """The odometry's pose, not the laser's, which others may have corrected; 80 m and beyond is no reading."""
    log = read_laser_log(written(tmp_path, CARMEN))
    np.testing.assert_allclose(log.ranges, [[2.0, 0.0, 1.0], [1.0, 1.0, 1.0]])
    np.testing.assert_allclose(log.angles, [-np.pi / 2.0, 0.0, np.pi / 2.0])
    np.testing.assert_allclose(log.motions, [[np.cos(0.5), -np.sin(0.5), 0.5]], atol=1e-6)
    assert log.poses is None and len(log.loops) == 0


def test_laser_scans_take_the_odometry_before_them(tmp_path):
    scan = "ROBOTLASER1 0 0 3 1 50.0 0.1 0 3 1 2 3 0 5 5 0 5 5 0 0 0 0 0 0 9.5 host 0.1\n"
    text = "ODOM 0 0 0 0 0 0 1 h 1\n" + scan + "ODOM 1 2 0 0 0 0 1 h 1\n" + scan
    np.testing.assert_allclose(read_laser_log(written(tmp_path, text)).motions, [[1.0, 2.0, 0.0]], atol=1e-6)


def test_a_compressed_log_is_the_same(tmp_path):
    (tmp_path / "drive.log.gz").write_bytes(gzip.compress(GRAPH.encode()))
    np.testing.assert_array_equal(read_laser_log(tmp_path / "drive.log.gz").ranges[1], [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "file: expected lines ROBOTLASER1 or FLASER"),
        ("FLASER 3 1 2 x 0 0 0 0 0 0 1 h 1\n", "line 1: expected the fields of FLASER"),
        ("FLASER 3 1 2 3 0 0 0 0 0\n", "line 1: expected the fields of FLASER"),
        ("FLASER 3 1 2 3 0 0 0 nan 0 0 1 h 1\n", "line 1: expected the fields of FLASER"),
        ("FLASER 99999 1\n", "line 1: expected the fields of FLASER"),
        (CARMEN + "FLASER 2 1 1 0 0 0 0 0 0 1 h 1\n", "line 6: expected 3 readings .* found 2"),
        (GRAPH.replace("EDGE2 1 2 1.0 0.0 -0.5", "EDGE2 2 1 1.0 0.0 -0.5"), "one from each scan .* none from 1"),
        (GRAPH + "EDGE2 0 3 1 1 1\n", "numbers of two of the 3 scans; found 0 and 3"),
        (GRAPH.replace("VERTEX2 1 ", "VERTEX2 7 "), "VERTEX2: expected one for each scan, or none; scan 1"),
    ],
)
def test_a_bad_log_is_one_clear_error(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read_laser_log(written(tmp_path, text))


@pytest.mark.parametrize("content", [b"\x1f\x8b broken", b"FLASER \xff\xfe", None])
def test_what_is_no_text_is_refused(tmp_path, content):
    path = tmp_path / "drive.log"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match="file: expected"):
        read_laser_log(path)


def test_a_part_has_the_loops_within_it():
    log = random_log(3, 12, 4, judged=True)
    part = log.part(2, 9)
    assert len(part) == 7 and len(part.motions) == 6
    np.testing.assert_array_equal(part.ranges, log.ranges[2:9])
    within = [i for i, (a, b) in enumerate(log.loops.tolist()) if 2 <= a < 9 and 2 <= b < 9]
    np.testing.assert_array_equal(part.loops + 2, log.loops[within])
    np.testing.assert_array_equal(part.relations, log.relations[within])
