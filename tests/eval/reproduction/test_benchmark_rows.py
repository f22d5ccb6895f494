"""Test rows of the benchmark run again, track by track; a folder of neither a sweep, a study nor a track is refused."""

import json

import pytest

from tests.helpers.paths import BASELINES
from tests.helpers.sweeps.benchmark_suites import write_suite
from vssm_gym.cli.sweeps.reproduce import reproduce
from vssm_gym.errors import InputError
from vssm_gym.eval.benchmark.run import run_benchmark
from vssm_gym.eval.benchmark.units import ROWS
from vssm_gym.eval.reproduction import benchmark_rows
from vssm_gym.eval.reproduction.studies import STUDIES


@pytest.mark.parametrize("track", ["slam", "prediction"])
def test_committed_rows_of_the_benchmark_can_be_run_again(track):
    folder = BASELINES / "benchmark" / "small-v1" / track
    (kind,) = [kind for kind in STUDIES if kind.rows(folder)]
    assert kind.name == "benchmark"
    assert {(row["suite"], row["track"]) for row in kind.rows(folder)} == {("small-v1", track)}


WALK = """name: walk
tracks:
  slam:
    kind: slam
    about: Follow a camera.
    seconds: 20
    recordings:
      - {scene: rooms.json, motion: handheld, length: 1}
"""


@pytest.mark.slow
def test_rows_of_the_benchmark_are_run_again_and_an_altered_score_is_named(tmp_path, capsys, monkeypatch):
    suite, out = write_suite(tmp_path, WALK), tmp_path / "out"
    monkeypatch.setattr(benchmark_rows, "suite_file", lambda name: {"walk": suite}[name])
    run_benchmark(suite, ["standing_still"], out)
    reproduce(out / "slam", tmp_path / "again")
    assert "1 of 1 rows have the same outcome" in capsys.readouterr().out
    rows = out / "slam" / ROWS
    (row,) = map(json.loads, rows.read_text().splitlines())
    rows.write_text(json.dumps(row | {"score": row["score"] + 0.01}) + "\n")
    with pytest.raises(SystemExit):
        reproduce(out / "slam", tmp_path / "altered")
    assert (
        f"suite walk, track slam, entry standing_still, unit {row['unit']}: score: expected" in capsys.readouterr().out
    )
    rows.write_text(json.dumps(row | {"unit": "another"}) + "\n")
    with pytest.raises(InputError, match="unit: expected one of rooms-handheld"):
        reproduce(out / "slam", tmp_path / "refused")


def test_a_folder_of_neither_is_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"expected a sweep or a study whose rows can be run again \(episodes\.jsonl"):
        reproduce(tmp_path / "empty", tmp_path / "out")
    with pytest.raises(InputError, match="the folder of one track of this run of the benchmark: car, exploration"):
        reproduce(BASELINES / "benchmark" / "small-v1", tmp_path / "out")
