"""Test ``bench beliefs``: the filter's Gaussian of a pose is the cautious one, and a few images show it."""

import json
from pathlib import Path

import pytest

from vssm_gym.cli.bench import bench
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.pose_beliefs import BELIEFS


@pytest.mark.slow
def test_the_filter_states_more_than_the_curvature(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    bench("beliefs", out=tmp_path / "out", trials=10)
    found = json.loads((tmp_path / "out" / "beliefs-oak.json").read_text())["beliefs"]
    assert tuple(found) == BELIEFS
    assert found["filter"]["nees"] < 0.2 * found["laplace"]["nees"]
    assert found["variational"]["nees"] == pytest.approx(found["laplace"]["nees"], rel=0.05)
    assert "10 images" in capsys.readouterr().out


def test_a_scene_without_a_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="oak, whose map comes with the package"):
        bench("beliefs", scene="fern", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
