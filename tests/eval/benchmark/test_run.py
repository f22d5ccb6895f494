"""Test the benchmark as a whole: a stranger's agent enters, a crashing one fails in the table, and runs resume."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest

from tests.helpers.sweeps.benchmark_suites import write_agents, write_suite
from vssm_gym.agents import registry
from vssm_gym.errors import InputError
from vssm_gym.eval.benchmark import results, run
from vssm_gym.eval.benchmark.manifest import MANIFEST, Entrant, Manifest
from vssm_gym.eval.benchmark.prediction.levels import UNINFORMED
from vssm_gym.eval.benchmark.run import PAGE, RESULTS, run_benchmark
from vssm_gym.eval.benchmark.suite import SUITES, read_suite
from vssm_gym.eval.benchmark.units import ROWS, UnitRow
from vssm_gym.eval.episodes.log import FILE, read_rows
from vssm_gym.eval.report.page import write_report
from vssm_gym.eval.sweep import runner, worker

TRACKS = ("navigation", "mapping", "car", "exploration", "slam", "prediction")


@pytest.fixture
def in_process(tmp_path, monkeypatch):
    """Run episodes in this process, and forget what strangers registered."""

    def run(jobs, log, *rest):
        for job in jobs:
            log.append(worker.run(job))

    monkeypatch.setattr(registry, "AGENTS", dict(registry.AGENTS))
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(runner, "_run", run)
    monkeypatch.setattr(worker, "_agent", worker._agent.__wrapped__)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("strangers_"):
            del sys.modules[name]


def test_a_strangers_agent_enters_beside_a_crashing_one_and_one_of_the_package(in_process):
    suite, agents, out = write_suite(in_process), write_agents(in_process), in_process / "out"
    entries = [f"{agents}:Straight", f"{agents}:Crashing", "random", "vi_mpc"]
    page = run_benchmark(suite, entries, out, tracks=["mapping"])
    found = json.loads((out / RESULTS).read_text())
    assert found["suite"] == "rooms"
    assert {"processor", "cores", "accelerator"} <= found["machine"].keys()
    assert found["tracks"]["mapping"]["wall_seconds"] > 0.0
    assert found["tracks"]["mapping"]["processor_seconds"] > 0.0
    table = found["tracks"]["mapping"]["entries"]
    assert table.keys() == {"strangers_straight", "strangers_crash", "random"}  # the car's agent has its own track
    assert table["strangers_crash"]["score"]["mean"] == 0.0
    number = 1 + agents.read_text().splitlines().index('            raise ArithmeticError("no answer")')
    reason = f"ArithmeticError: no answer (strangers_agents.py, line {number})"
    assert table["strangers_crash"]["faults"] == {reason: 2}
    assert table["strangers_straight"]["faults"] == {}
    assert table["strangers_straight"]["p95"] < 0.2
    rows = read_rows(out / "mapping" / FILE)
    straight = [row["spl"] for row in rows if row["agent"] == "strangers_straight"]
    assert table["strangers_straight"]["score"]["mean"] == pytest.approx(np.mean(straight))
    crashed = [row for row in rows if row["agent"] == "strangers_crash"]
    assert {row["failure"] for row in crashed} == {f"fault: {reason}"}
    assert all(row["steps"] == 3 for row in crashed)
    text = page.read_text()
    assert "- strangers_crash: 2 of 2 runs: ArithmeticError: no answer" in text
    assert re.search(r"\| \d \| \*\*strangers_straight\*\* \| ", text)
    assert "- vi_mpc: no track that was run is for it; it enters car." in text
    assert "- No run of the package's own entries is committed for mapping as this suite has it." in text
    assert write_report(out / "mapping", 0, None).is_file()


def test_a_folder_resumes_only_the_same_suite_and_entries(in_process):
    suite, agents, out = write_suite(in_process), write_agents(in_process), in_process / "out"
    run_benchmark(suite, [f"{agents}:Straight"], out)
    log = out / "mapping" / FILE
    before = log.read_bytes()
    with pytest.raises(InputError, match=r"it holds mapping \(--resume continues it"):
        run_benchmark(suite, [f"{agents}:Straight"], out)
    with pytest.raises(InputError, match=r"benchmark\.json: entries: expected strangers_straight, as the run"):
        run_benchmark(suite, [f"{agents}:Straight", "random"], out, resume=True)
    manifest = json.loads((out / MANIFEST).read_text())
    manifest["entries"][0]["code"] = "0" * 16
    (out / "benchmark.json").rename(out / "kept.json")
    (out / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=r"benchmark\.json: entries\.strangers_straight: expected the code that the"):
        run_benchmark(suite, [f"{agents}:Straight"], out, resume=True)
    (out / "kept.json").rename(out / MANIFEST)
    assert log.read_bytes() == before
    log.write_bytes(before[: before.index(b"\n") + 1])
    run_benchmark(suite, [f"{agents}:Straight"], out, resume=True)
    again = read_rows(log)
    assert [row["task"] for row in again] == [0, 1]
    assert json.loads(before.splitlines()[1])["path_length"] == again[1]["path_length"]


def test_episodes_that_an_interrupted_run_has_left_are_not_those_of_a_fault(in_process, monkeypatch):
    suite, out = write_suite(in_process), in_process / "out"
    monkeypatch.setattr(runner, "_run", lambda jobs, log, *rest: log.append(worker.run(jobs[0])))
    run_benchmark(suite, ["random"], out)
    line = json.loads((out / RESULTS).read_text())["tracks"]["mapping"]["entries"]["random"]
    assert line["episodes"] == 2
    assert line["faults"] == {"not run yet: --resume runs it": 1}


def test_each_machine_and_version_that_ran_a_part_is_stated_however_often_the_run_goes_on(in_process, monkeypatch):
    suite, out, loads = write_suite(in_process), in_process / "out", {"A": 0.5, "B": 3.0, "C": 0.5}

    def on(name):
        """Run one episode that is left on a machine, by a version of its own; return the results and the page."""
        found = {"processor": name, "cores": 2, "of_cores": 2, "accelerator": None, "system": "Linux"}
        monkeypatch.setattr(run, "machine", lambda: found)
        monkeypatch.setattr(run, "package_version", lambda: f"of {name}")
        monkeypatch.setattr(run, "load", lambda: loads[name])
        page = run_benchmark(suite, ["random"], out, resume=True)
        return json.loads((out / RESULTS).read_text()), page.read_text()

    monkeypatch.setattr(runner, "_run", lambda jobs, log, *rest: log.append(worker.run(jobs[0])) if jobs else None)
    _, text = on("A")
    assert "A part was run" not in text
    for name in ("B", "A", "C"):  # one that has nothing left to run is not stated
        found, text = on(name)
        assert (found["machine"]["processor"], found["version"], found["load"]) == ("A", "of A", 0.5)
        assert re.findall("A part was run .*: (.+?)[,.]", text) == ["B", "of B"]
    assert [(one["machine"]["processor"], one["load"]) for one in found["resumed"]] == [("B", 3.0)]
    assert re.findall(r"\| this run .* \| of (.) \| (.), .* \| (.+) \|", text) == [
        ("A", "A", "0.5"),
        ("B", "B", "3.0"),
    ]
    [table] = results.tables(read_suite(suite), out, {})
    assert not table.places[0].steady  # B was busy
    assert read_rows(out / "mapping" / FILE)[1]["task"] == 1


@pytest.mark.parametrize(
    ("load", "workers", "steady"),
    [(0.5, 2, True), (0.5, 3, False), (1.5, 1, False), (0.5, None, True), (None, 1, False)],
)
def test_times_are_an_entrys_own_where_each_process_has_a_core(load, workers, steady):
    machine = {"cores": 2}
    manifest = Manifest(
        suite="s", suite_hash="h", tracks={}, entries=(), version="1", machine=machine, load=load, workers=workers
    )
    assert results._steady(manifest) == steady


def test_an_agent_begins_each_episode_without_a_memory(in_process):
    suite, agents, out = write_suite(in_process), write_agents(in_process), in_process / "out"
    run_benchmark(suite, [f"{agents}:Remembering"], out)
    rows = read_rows(out / "mapping" / FILE)
    assert len(rows) == 2
    assert not any("fault" in str(row["failure"]) for row in rows)


def test_references_of_the_same_suite_stand_beside_the_entries(in_process, monkeypatch):
    suite, agents = write_suite(in_process), write_agents(in_process)
    kept = in_process / "baselines" / "rooms"
    run_benchmark(suite, ["random"], kept)
    monkeypatch.setattr(results, "REFERENCES", kept.parent)
    page = run_benchmark(suite, [f"{agents}:Straight"], in_process / "out")
    table = json.loads((page.parent / RESULTS).read_text())["tracks"]["mapping"]
    assert (list(table["entries"]), list(table["references"])) == (["strangers_straight"], ["random"])
    assert {table["entries"]["strangers_straight"]["rank"], table["references"]["random"]["rank"]} == {1, 2}
    assert "random (reference)" in page.read_text()
    assert not results.references_of(read_suite(suite), kept)  # a run is no reference of itself
    manifest = json.loads((kept / MANIFEST).read_text())
    other = manifest | {"tracks": manifest["tracks"] | {"mapping": "0" * 16}}
    (kept / MANIFEST).write_text(json.dumps(other))
    page = run_benchmark(suite, [f"{agents}:Straight"], in_process / "out", resume=True)
    assert "random" not in page.read_text()  # its rows are of another track of that name


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"tracks": ["cars"]}, "tracks: expected one of mapping, car"),
        ({"tracks": ["car"]}, "tracks: expected a track that an entry is for; found car"),
        ({"workers": 0}, "workers: expected at least 1, found 0"),
    ],
)
def test_wrong_arguments_are_refused_before_anything_is_written(in_process, keywords, message):
    with pytest.raises(InputError, match=message):
        run_benchmark(write_suite(in_process), ["random"], in_process / "out", **keywords)
    assert not (in_process / "out").exists()


@pytest.mark.slow
def test_the_command_scores_a_strangers_file_in_worker_processes(tmp_path):
    suite, agents = write_suite(tmp_path), write_agents(tmp_path)
    program = "import sys; from vssm_gym.cli.main import program; program()"
    words = ["benchmark", str(suite), "--entry", f"{agents.name}:Straight", f"{agents.name}:Crashing", "--out", "out"]
    done = subprocess.run([sys.executable, "-c", program, *words], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "ArithmeticError: no answer" in done.stdout
    assert (tmp_path / "out" / PAGE).read_text().splitlines()[0] == "# Benchmark rooms"
    wrong = subprocess.run(
        [sys.executable, "-c", program, *words[:2], "--entry", "nobody", "--out", "o"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert wrong.returncode == 2
    assert wrong.stderr.startswith("error: benchmark: entry: expected FILE.py:CLASS")
    assert wrong.stderr.count("\n") == 1


@pytest.mark.slow
def test_an_entry_that_ends_its_process_loses_its_own_episodes_alone(tmp_path):
    suite, agents = write_suite(tmp_path), write_agents(tmp_path)
    program = "import sys; from vssm_gym.cli.main import program; program()"
    entries = [f"{agents.name}:{name}" for name in ("Dying", "Straight")]
    words = ["benchmark", str(suite), "--entry", *entries, "--out", "out"]

    def run(*more):
        return subprocess.run([sys.executable, "-c", program, *words, *more], cwd=tmp_path, capture_output=True)

    done = run()
    assert done.returncode == 0, done.stderr
    table = json.loads((tmp_path / "out" / RESULTS).read_text())["tracks"]["mapping"]["entries"]
    assert table["strangers_death"]["faults"] == {"its process has died, or did not return": 2}
    assert table["strangers_straight"]["faults"] == {}
    assert table["strangers_straight"]["p95"] is not None
    log = tmp_path / "out" / "mapping" / FILE
    before = log.read_bytes()
    assert len(before.splitlines()) == 4
    assert run("--resume").returncode == 0
    assert log.read_bytes() == before


def test_results_are_written_of_tracks_that_an_interrupted_run_has_left(tmp_path):
    suite = read_suite(SUITES / "small-v1.yaml")
    machine = {"processor": "CPU", "cores": 1, "of_cores": 2, "accelerator": None, "system": "Linux"}
    kinds = {"slam": "slam", "prediction": "predictor"}
    entries = tuple(Entrant(label=f"my_{name}", kind=kind, tracks=(name,)) for name, kind in kinds.items())
    manifest = Manifest(suite="s", suite_hash="0", tracks={}, entries=entries, version="1", machine=machine)
    (tmp_path / MANIFEST).write_text(manifest.model_dump_json())
    for name in kinds:
        (tmp_path / name).mkdir()
        (tmp_path / name / ROWS).touch()
    references = results.references_of(suite, tmp_path)
    slam, prediction = (results.as_json(table) for table in results.tables(suite, tmp_path, references))
    json.dumps([slam, prediction], allow_nan=False)
    assert (slam["entries"]["my_slam"]["rank"], slam["entries"]["my_slam"]["score"]["mean"]) == (None, None)
    assert slam["entries"]["my_slam"]["faults"] == {"not run yet: --resume runs it": 3}
    assert slam["references"]["prism"]["rank"] == 1
    assert prediction["entries"]["my_prediction"]["score"]["mean"] == pytest.approx(UNINFORMED)
    assert results.unfinished(suite, tmp_path, kinds)


def test_content_that_differs_from_that_of_a_reference_is_said(tmp_path):
    suite = read_suite(SUITES / "small-v1.yaml")
    folders = [tmp_path / name for name in ("own", "kept")]
    for folder, contents in zip(folders, (("a", "b"), ("a", "c")), strict=True):
        (folder / "slam").mkdir(parents=True)
        rows = [
            UnitRow(
                entry="mine", unit=f"walk-{k}", score=0.1, success=True, fault=None, p95=None, measured={}, content=one,
                version="1",
            )
            for k, one in enumerate(contents)
        ]  # fmt: skip
        (folder / "slam" / ROWS).write_text("".join(row.model_dump_json() + "\n" for row in rows))
    machine = {"processor": "CPU", "cores": 1, "of_cores": 2, "accelerator": None, "system": "Linux"}
    tracks = {"slam": suite.track_hash("slam")}
    kept = Manifest(suite="s", suite_hash="0", tracks=tracks, entries=(), version="1", machine=machine)
    [notice] = results.differing_content(suite, folders[0], {folders[1]: kept})
    assert notice.startswith("slam: walk-1 differ from those of the reference kept")
    other = kept.model_copy(update={"tracks": {"slam": "0" * 16}})
    assert results.differing_content(suite, folders[0], {folders[1]: other}) == []


@pytest.mark.parametrize("track", TRACKS)
def test_each_track_of_the_small_suite_has_references(track, tmp_path):
    suite = read_suite(SUITES / "small-v1.yaml")
    assert set(TRACKS) == set(suite.tracks)
    committed = results.references_of(suite, tmp_path)
    found = [table.name for folder in committed for table in results.tables(suite, folder, {})]
    assert track in found


def test_committed_references_are_rows_of_tracks_of_public_suites(tmp_path):
    suites = [read_suite(path) for path in SUITES.glob("*.yaml")]
    for folder in (path.parent for path in results.REFERENCES.glob(f"*/{MANIFEST}")):
        [suite] = [suite for suite in suites if folder in results.references_of(suite, tmp_path)]
        tables = results.tables(suite, folder, {})
        assert tables
        for table in tables:
            assert table.places
            for place in table.places:
                assert np.isfinite(place.line.score.mean)
                assert place.line.episodes > 0
                assert not any("not run yet" in reason for reason in place.line.faults)
