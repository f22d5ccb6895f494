"""Test the field of sweeps that came later: configurations, keys and rows without it are those from before."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest

import vssm_gym
from tests.eval.report.test_report import episode
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import FILE, EpisodeLog, episode_key, read_rows
from vssm_gym.eval.episodes.manifest import completed
from vssm_gym.eval.metrics.aggregate import paired_difference
from vssm_gym.eval.protocols.agent_context import agent_context
from vssm_gym.eval.report import tables
from vssm_gym.eval.sweep.config import SweepConfig, check_names, expand, load_config
from vssm_gym.eval.sweep.manifest import config_hash

BODY = SweepConfig(scenes=("oak",), agents=("astar",), tasks=(0, 1))
BOTH = BODY.model_copy(update={"direction_frame": ("body", "world")})


def test_the_identity_in_the_body_frame_is_that_of_rows_without_the_field():
    body, world = ([e for e in expand(BOTH) if e.condition.direction_frame == frame] for frame in ("body", "world"))
    assert len(body) == len(world) == 2
    identity = body[0].identity("h")
    assert identity == next(expand(BODY)).identity("h")
    assert "direction_frame" not in identity
    assert world[0].identity("h") == {**identity, "direction_frame": "world"}
    keys = {episode_key(e.identity("h")) for e in expand(BOTH)}
    assert len(keys) == 4
    assert episode_key({**identity, "direction_frame": "body"}) == episode_key(identity)


def test_the_hash_of_a_configuration_counts_another_frame_only():
    """A sweep from before the field existed can be resumed."""
    of = lambda config: config_hash(config, {"oak": "h"}, 0)
    assert of(BODY) == of(BODY.model_copy(update={"direction_frame": ("body",)})) == "053472766f7c2149"
    assert of(BODY.model_copy(update={"map_surfaces": "exact"})) != of(BODY)
    assert len({of(BODY), of(BOTH), of(BODY.model_copy(update={"direction_frame": ("world",)}))}) == 3


def test_rows_read_back_as_they_were_written(tmp_path):
    old = episode("astar", 0, True)
    new = {**old, "direction_frame": "world"}
    with EpisodeLog(tmp_path / FILE) as log:
        log.append(old)
        log.append(new)
    assert [{k: v for k, v in row.items() if k != "format"} for row in read_rows(tmp_path / FILE)] == [old, new]


@pytest.mark.parametrize("frames", [["body"], ["world"], ["body", "world"]])
def test_a_row_is_completed_with_the_only_frame(frames):
    row = completed({"task": 0}, {"config": {"direction_frame": frames, "physics": ["mujoco"]}})
    assert row.get("direction_frame") == ("world" if frames == ["world"] else None)


def test_tables_name_the_frame_where_it_varies():
    rows = [episode("astar", task, True) for task in range(3)]
    turned = [{**row, "direction_frame": "world", "spl": 0.5} for row in rows]
    assert "direction_frame" not in tables.grouping(rows)
    table = tables.results([*rows, *turned], 0)
    assert "direction frame" in table.header
    at = table.header.index("direction frame")
    assert [line[at] for line in table.lines] == ["body", "world"]
    assert paired_difference([*rows, *turned], "spl", "world", "body", by="direction_frame").episodes == 3


def test_only_the_holonomic_robot_has_directions(tmp_path):
    check_names(BOTH, "here")
    check_names(BODY.model_copy(update={"noise": ("locobot",)}), "here")
    car = "env: vssm_gym/CarNav-v0\nscenes: arena\nagents: greedy\ntasks: 1\nrobot: car\n"
    for field, bad in (("direction_frame", "world"), ("noise", "locobot")):
        (tmp_path / "car.yaml").write_text(f"{car}{field}: {bad}\n")
        with pytest.raises(InputError, match=f"{field}: expected one of .*; found '{bad}'"):
            load_config(tmp_path / "car.yaml")


def test_a_worn_drive_has_no_compass():
    check_names(BODY.model_copy(update={"robot": ("holonomic", "worn")}), "here")
    with pytest.raises(InputError, match="here: direction_frame: expected body with the robot worn"):
        check_names(BOTH.model_copy(update={"robot": ("holonomic", "worn")}), "here")


def test_agents_know_the_frame_and_the_law_of_the_noise():
    assert vssm_gym
    env = gym.make("vssm_gym/PointNav-v0", scene="oak", noise="locobot", direction_frame="world")
    _, info = env.reset(seed=0)
    context = agent_context(env, info)
    noise, robot = env.unwrapped.noise, env.unwrapped.robot
    assert (context.direction_frame, context.transition.direction_frame) == ("world", "world")
    np.testing.assert_array_equal(context.limits, robot.limits)
    assert context.noise == noise.deviations(robot.max_step)
    assert dataclasses.asdict(noise) == {name: getattr(context.transition.noise, name) for name in vars(noise)}
