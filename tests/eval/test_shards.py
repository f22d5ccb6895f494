"""Test shards of a sweep: a partition that keeps pairs together, and a merge that equals the undivided sweep."""

import json
import re
import shutil

import hypothesis.strategies as st
import pytest
from hypothesis import given

from tests.eval.test_protocols import vssm
from tests.eval.test_sweep import untimed
from tests.helpers.box_rooms import two_rooms
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import FILE, read_rows
from vssm_gym.eval.episodes.manifest import MANIFEST
from vssm_gym.eval.report.page import write_report
from vssm_gym.eval.sweep.config import SweepConfig, expand, load_config
from vssm_gym.eval.sweep.merge import merge_sweeps
from vssm_gym.eval.sweep.runner import run_sweep
from vssm_gym.eval.sweep.shards import Shard
from vssm_gym.maps.map_file import map_hash

MAZES = """env: vssm_gym/LidarMaze-v0
robot: disc
physics: none
scenes: [pillars-v1, rooms-v1]
agents: dist_bug
tasks: [0, 7, 30]
noise: [none, low]
"""


def units(episodes):
    return {(e.condition.scene, e.task) for e in episodes}


@given(
    scenes=st.integers(1, 4), tasks=st.integers(1, 9), agents=st.integers(1, 3), noises=st.integers(1, 2), of=st.data()
)
def test_every_episode_is_in_one_shard_together_with_its_pairs(scenes, tasks, agents, noises, of):
    config = SweepConfig(
        scenes=tuple(f"s{i}" for i in range(scenes)),
        agents=tuple(f"a{i}" for i in range(agents)),
        noise=("none", "low")[:noises],
        tasks=tuple(range(tasks)),
    )
    whole = list(expand(config))
    n = of.draw(st.integers(1, scenes * tasks))
    parts = [Shard(i, n).part(whole) for i in range(1, n + 1)]
    assert sorted(str(e) for part in parts for e in part) == sorted(map(str, whole))
    assert sum(len(units(part)) for part in parts) == len(units(whole))  # no task of a scene in two shards
    sizes = [len(units(part)) for part in parts]
    assert 1 <= min(sizes) <= max(sizes) <= min(sizes) + 1
    order = [whole.index(e) for e in parts[0]]
    assert order == sorted(order)
    # Contiguous: the scenes that two shards share, and so the maps that are learned twice, are as few as can be.
    assert sum(len({e.condition.scene for e in part}) for part in parts) <= scenes + n - 1


@pytest.mark.parametrize("text", ["0/3", "4/3", "2", "a/b", "1/0", "-1/3", "1/3/5", "", "1.0/2"])
def test_an_invalid_shard_is_refused(text):
    with pytest.raises(InputError, match="shard: expected I/N with 1 <= I <= N, as in 2/5"):
        Shard.parse(text)


def test_more_shards_than_tasks_are_refused():
    config = SweepConfig(scenes=("oak",), agents=("random",), tasks=(0, 1, 2))
    with pytest.raises(InputError, match="at most 3 shards"):
        Shard(1, 4).part(list(expand(config)))


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Run a sweep in one piece and in three, in this process."""
    path = tmp_path_factory.mktemp("shards")
    (path / "sweep.yaml").write_text(MAZES)
    config = load_config(path / "sweep.yaml")
    run_sweep(config, path / "whole", workers=1)
    for i in (1, 2, 3):
        run_sweep(config, path / f"part-{i}", workers=1, shard=Shard(i, 3))
    return path


def parts(sweep):
    return [sweep / f"part-{i}" for i in (2, 3, 1)]


def test_merged_shards_are_the_whole_sweep(sweep, tmp_path):
    merged = merge_sweeps(parts(sweep), tmp_path / "merged")
    assert merged.notices == ()
    rows, whole = read_rows(merged.log), read_rows(sweep / "whole" / FILE)
    assert len(rows) == len(whole) == 12
    assert untimed(rows) == untimed(whole)
    assert json.loads((tmp_path / "merged" / MANIFEST).read_text()) == json.loads(
        (sweep / "whole" / MANIFEST).read_text()
    )
    for tasks in (sweep / "whole" / "tasks").iterdir():
        assert (tmp_path / "merged" / "tasks" / tasks.name).read_bytes() == tasks.read_bytes()
    assert sorted(path.name for path in (tmp_path / "merged").iterdir()) == sorted([FILE, MANIFEST, "tasks"])
    assert write_report(tmp_path / "merged").stat().st_size > 10_000
    run_sweep(load_config(sweep / "sweep.yaml"), tmp_path / "merged", resume=True)  # nothing is left to run
    assert read_rows(merged.log) == rows
    assert [path.name for path in tmp_path.iterdir()] == ["merged"]


def test_a_shard_resumes_as_that_shard_only(sweep, tmp_path):
    shutil.copytree(sweep / "part-1", tmp_path / "part")
    lines = (tmp_path / "part" / FILE).read_bytes().splitlines(keepends=True)
    (tmp_path / "part" / FILE).write_bytes(b"".join(lines[:2]))
    config = load_config(sweep / "sweep.yaml")
    for other in (None, Shard(2, 3), Shard(1, 2)):
        with pytest.raises(InputError, match=r"shard: expected .*another sweep belongs into another folder"):
            run_sweep(config, tmp_path / "part", resume=True, shard=other)
    with pytest.raises(InputError, match=r"episodes: expected 4 episodes; it holds 2 \(sweep --resume continues it\)"):
        merge_sweeps([tmp_path / "part", sweep / "part-2", sweep / "part-3"], tmp_path / "merged")
    log = run_sweep(config, tmp_path / "part", resume=True, workers=1, shard=Shard(1, 3))
    assert untimed(read_rows(log)) == untimed(read_rows(sweep / "part-1" / FILE))


def refused(folders, out, message):
    before = sorted(out.parent.iterdir())
    with pytest.raises(InputError, match=message):
        merge_sweeps(folders, out)
    assert sorted(out.parent.iterdir()) == before  # nothing half written


@pytest.mark.parametrize(
    ("index", "of", "field"), [(1, "3", "of"), (1, 10**18, "of"), ([1], 3, "index"), (4, 3, "index")]
)
def test_a_shard_of_no_number_is_refused(tmp_path, index, of, field):
    manifest = {"config": {}, "config_hash": "", "version": "", "seed": 0, "episodes": 1}
    (tmp_path / MANIFEST).write_text(json.dumps(manifest | {"shard": {"index": index, "of": of}}))
    refused([tmp_path], tmp_path / "out", f"shard.{field}: expected a whole number from 1 to ")


def test_an_incomplete_set_of_shards_is_refused(sweep, tmp_path):
    first, second, third = (sweep / f"part-{i}" for i in (1, 2, 3))
    out = tmp_path / "merged"
    refused([second], out, "folders: expected all 3 shards; 1, 3 of 3 missing")
    refused([first, second, second, third], out, "each shard once; .*part-2 is shard 2, too")
    refused([sweep / "whole", second, third], out, "shard: expected a shard's folder")
    refused([first, second, tmp_path / "none"], out, r"sweep\.json: file: expected a sweep's folder")
    refused([], out, "folders: expected the folders of a sweep's shards")
    other = tmp_path / "other"
    shutil.copytree(third, other)
    manifest = json.loads((other / MANIFEST).read_text())
    (other / MANIFEST).write_text(json.dumps(manifest | {"config_hash": "0" * 16}))
    refused([first, second, other], out, "config_hash: expected .* in 3 shards, as .*part-1; found 0000")
    (other / MANIFEST).write_text(json.dumps(manifest | {"shard": {"index": 3, "of": 4}}))
    refused([first, second, other], out, "config_hash: expected .* in 3 shards, .*found .* in 4")
    (other / MANIFEST).write_text(json.dumps(manifest))
    shutil.copy(second / FILE, other / FILE)
    refused([first, second, other], out, "episodes: expected each episode in one shard")
    shutil.copy(third / FILE, other / FILE)
    for tasks in (other / "tasks").iterdir():
        tasks.write_text(tasks.read_text() + " ")
    refused([first, second, other], out, "file: expected the same tasks in every shard")
    refused([first, second, third], sweep / "whole", "folder: expected a new or empty folder")


def test_shards_of_other_versions_and_maps_are_reported(sweep, tmp_path):
    for i in (1, 2, 3):
        shutil.copytree(sweep / f"part-{i}", tmp_path / f"{i}")
        (tmp_path / f"{i}" / "maps").mkdir()
        (tmp_path / f"{i}" / "maps" / "rooms-v1.npz").write_bytes(bytes([i // 2]))
    manifest = json.loads((tmp_path / "3" / MANIFEST).read_text())
    (tmp_path / "3" / MANIFEST).write_text(json.dumps(manifest | {"version": "9.9"}))
    merged = merge_sweeps([tmp_path / f"{i}" for i in (1, 2, 3)], tmp_path / "merged")
    versions, *maps = merged.notices
    assert versions.endswith(", 9.9")
    assert len(maps) == 2  # those of the second and third differ from the first
    assert (tmp_path / "merged" / "maps" / "rooms-v1.npz").read_bytes() == bytes([0])


@pytest.mark.slow
def test_shards_with_learned_maps_by_the_command_line(tmp_path):
    """Two shards of one scene learn the same map; merged, they equal one sweep, including its pictures."""
    save_scene(two_rooms(), tmp_path / "rooms.json")
    text = "scenes: rooms.json\nagents: [oracle, random]\ntasks: 2\nvoxel: 0.1\n"
    (tmp_path / "sweep.yaml").write_text(text)
    for out, shard in (("whole", ()), ("a", ("--shard", "1/2")), ("b", ("--shard", "2/2"))):
        swept = vssm("sweep", tmp_path / "sweep.yaml", "--out", tmp_path / out, *shard)
        assert swept.returncode == 0, swept.stderr
        assert ("next: vssm-gym merge" in swept.stdout) == bool(shard)
    missing = vssm("merge", tmp_path / "a", "--out", tmp_path / "merged")
    assert (missing.returncode, missing.stdout) == (2, "")
    assert missing.stderr == "error: merge: folders: expected all 2 shards; 2 of 2 missing\n"
    merged = vssm("merge", tmp_path / "b", tmp_path / "a", "--out", tmp_path / "merged")
    assert merged.returncode == 0, merged.stderr
    assert "warning" not in merged.stderr
    assert untimed(read_rows(tmp_path / "merged" / FILE)) == untimed(read_rows(tmp_path / "whole" / FILE))
    maps = [map_hash(tmp_path / out / "maps" / "rooms.npz") for out in ("merged", "whole", "a", "b")]
    assert len(set(maps)) == 1
    assert sorted(p.name for p in (tmp_path / "merged").iterdir()) == sorted(
        p.name for p in (tmp_path / "whole").iterdir()
    )
    pages = [write_report(tmp_path / out).read_text() for out in ("merged", "whole")]
    drawn = [re.findall(r"data:image/webp[^\"']+", page) for page in pages]
    assert drawn[0] == drawn[1]
    assert drawn[0]
