"""Test the study of an ambiguous pose: measures by hand, the uniform prior, and all of it with little effort."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.cli.studies import posteriors as commands
from vssm_gym.errors import InputError
from vssm_gym.eval.studies.pose_ambiguity import study as ambiguity_study
from vssm_gym.eval.studies.pose_ambiguity.modes import histogram, parts, spread
from vssm_gym.maps.planar_map import PlanarMap

TRUE = np.array([0.12, 0.12, 0.1])


def test_two_places_are_two_modes_with_their_shares() -> None:
    poses = np.repeat([[0.12, 0.12, 0.1], [0.62, 0.42, 0.1]], 500, axis=0)
    weight = np.repeat([0.7, 0.3], 500) / 500
    found = spread(poses, weight, TRUE)
    assert found.modes == 2
    assert found.entropy == pytest.approx(-0.7 * np.log(0.7) - 0.3 * np.log(0.3))
    assert found.largest == pytest.approx(0.7) and found.at_truth == pytest.approx(0.7)


def test_opposite_headings_at_one_place_are_two_modes_and_half_a_turn_is_no_border() -> None:
    weight = np.full(400, 1.0 / 400)
    opposite = np.tile(TRUE, (400, 1))
    opposite[200:, 2] += np.pi
    assert spread(opposite, weight, TRUE).modes == 2
    about = np.tile(TRUE, (400, 1))
    about[:, 2] = np.tile([np.pi - 0.01, -np.pi + 0.01], 200)
    found = spread(about, weight, np.array([0.12, 0.12, np.pi]))
    assert found.modes == 1 and found.at_truth == pytest.approx(1.0)


def test_places_that_meet_at_two_headings_are_one_part() -> None:
    """A ring of all headings, open nowhere, and bins that touch the first heading from both of its sides."""
    mass = np.zeros((2, 3, 16))
    mass[0, 0, [0, 1, 15]] = 1.0
    mass[1, 2, 8] = 1.0
    found = parts(mass)
    assert found.max() == 2 and len({found[0, 0, k] for k in (0, 1, 15)}) == 1
    np.testing.assert_array_equal(found > 0, mass > 0.0)


def test_a_light_place_is_no_mode() -> None:
    poses = np.repeat([[0.12, 0.12, 0.1], [0.62, 0.42, 0.1], [0.92, 0.9, 2.0]], 100, axis=0)
    weight = np.repeat([0.9, 0.095, 0.005], 100) / 100
    assert spread(poses, weight, TRUE).modes == 2
    assert histogram(poses, weight).sum() == pytest.approx(1.0)


def test_the_prior_is_uniform_over_what_is_known_to_be_free() -> None:
    """Half of the observed free cells lie left of the middle; unknown and occupied cells have no particle."""
    m = PlanarMap.prior(np.zeros(2), np.array([0.9, 0.4]), 0.1)
    occupancy, precision = np.full((10, 5), 1.0), np.full((10, 5), 1e9)
    occupancy[1:9, 1:4] = -0.02
    precision[8, 1:4] = m.precision[0, 0]
    m = PlanarMap(jnp.asarray(occupancy), jnp.asarray(precision), m.origin, m.cell_size)
    poses = np.asarray(ambiguity_study.uniform(jax.random.key(0), m, 20_000).states)
    assert (poses[:, :2] >= [0.05, 0.05]).all() and (poses[:, :2] <= [0.75, 0.35]).all()
    cells = np.floor((poses[:, :2] - 0.05) / 0.1).astype(int).clip(0, [6, 2])
    counts = np.bincount(3 * cells[:, 0] + cells[:, 1], minlength=21)
    np.testing.assert_allclose(counts / 20_000, 1.0 / 21, rtol=0.2)
    assert abs(np.mean(np.exp(1j * poses[:, 2]))) < 0.03


@pytest.mark.parametrize(("field", "change"), [("scans", {"scans": 1}), ("particles", {"particles": 3})])
def test_bad_options_write_nothing(tmp_path: Path, field: str, change: dict[str, int]) -> None:
    with pytest.raises(InputError, match=field):
        commands.pose_ambiguity(out=tmp_path / "out", **change)
    assert not (tmp_path / "out" / "pose-ambiguity.json").exists()


@pytest.mark.slow
def test_the_study_runs_from_end_to_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A few particles and scans: the belief shrinks from the prior, and the command writes its files."""
    monkeypatch.setattr(ambiguity_study, "MAPPING_STEPS", 60)
    commands.pose_ambiguity(out=tmp_path, maze="pillars-v1", scans=8, particles=300)
    stored = json.loads((tmp_path / "pose-ambiguity.json").read_text())
    found = stored["figures"]["by_scans"]
    assert len(found) == 9
    assert found[-1]["entropy"] < found[0]["entropy"]
    assert all(0.0 <= one["at_truth"] <= 1.0 + 1e-5 and one["modes"] >= 0 for one in found)
    assert (tmp_path / "pose-ambiguity.html").is_file() and (tmp_path / "pose-ambiguity.svg").is_file()
