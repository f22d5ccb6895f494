"""Drive the episodes of a sweep's configuration, one after the other, and keep every step for a data set."""

import itertools
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.agents.policy.policy_file import agent_label
from vssm_gym.data.datasets.episode import Block, Description, Episode, plain
from vssm_gym.envs.scenes.faults import SceneWarning
from vssm_gym.envs.scenes.generator import PREFIX
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.recorder import RecordedEnv
from vssm_gym.eval.protocols.registry import SWEPT_ENVIRONMENTS, protocol_of
from vssm_gym.eval.sweep import worker
from vssm_gym.eval.sweep.config import CONDITIONS, SweepConfig, expand
from vssm_gym.eval.sweep.given_map import copy_map
from vssm_gym.eval.sweep.jobs import jobs_of
from vssm_gym.eval.sweep.manifest import manifest_of
from vssm_gym.files.shipped import MAPS, shipped
from vssm_gym.progress import OnProgress

LISTED = ("scene", *(name for name in CONDITIONS if name != "robot"))  # keywords that a configuration may vary


def recorded_episodes(
    config: SweepConfig,
    scratch: Path,
    seed: int = 0,
    map_file: Path | None = None,
    on_progress: OnProgress | None = None,
) -> tuple[Description, Iterator[Episode]]:
    """Return what is common to all episodes of a configuration, and the episodes, each driven when it is asked for.

    They are those of ``vssm-gym sweep``: the same tasks, seeds and settings of the environment, and the same agents.
    An episode's metadata is its row of the episode log, with the task, the seed of the reset and the keywords of
    ``gym.make``; an agent that gives up outside of the environment truncates it. Episodes without a step are left out.

    Args:
        config: checked by :func:`vssm_gym.eval.sweep.config.load_config`; it has one environment.
        scratch: folder for tasks, and for the maps that agents need.
        seed: of the recorded drives that maps are learned from.
        map_file: a map for the agents of a configuration of one scene; None: maps are learned.
        on_progress: called with ("recording" | "map" | "episodes", done, total).

    Raises:
        InputError: several environments, agents that observe differently, no episode with a step, or what a sweep
            refuses.
    """
    if len(config.env) > 1:
        raise InputError("dataset", "env", f"one environment, whose observations a data set has; found {config.env}")
    _check_observations(config)
    episodes = _episodes(config, scratch, seed, map_file, on_progress)
    first = next(episodes, None)
    if first is None:
        raise InputError("dataset", "episodes", "one with a step; every agent gave up at once")
    env, episode = first
    return _description(config, env, episode), itertools.chain([episode], (later for _, later in episodes))


def _check_observations(config: SweepConfig) -> None:
    """Raise :class:`InputError` where some agents are shown the true pose and others are not, before any is driven."""
    from vssm_gym.agents.registry import agent_type

    shown = [agent for agent in config.agents if agent_type(agent).needs_pose]
    if 0 < len(shown) < len(config.agents):
        others = [agent for agent in config.agents if agent not in shown]
        expected = (
            f"agents with the same observations; found {', '.join(shown)} with the true pose, {', '.join(others)} "
            "without (--agents chooses some of them)"
        )
        raise InputError("dataset", "agents", expected)


def _episodes(
    config: SweepConfig, scratch: Path, seed: int, map_file: Path | None, on_progress: OnProgress | None
) -> Iterator[tuple[RecordedEnv, Episode]]:
    protocol = protocol_of(config.env[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)  # the command prints them as notices
        apartments = {scene: protocol.load(scene) for scene in config.scenes}
        wanted = list(expand(config))
        if map_file is not None:
            map_file = shipped(map_file, MAPS)
        manifest = manifest_of(config, apartments, seed, len(wanted), map_file=map_file)
        if map_file is not None:
            copy_map(map_file, scratch / "maps" / f"{scene_name(config.scenes[0])}.npz")
        done = 0
        for scene in config.scenes:
            batch = [episode for episode in wanted if episode.condition.scene == scene]
            for job in jobs_of(batch, scene, apartments[scene], scratch, config, manifest, on_progress):
                kept: list[RecordedEnv] = []

                def keep(env: gym.Env) -> gym.Env:
                    kept.append(RecordedEnv(env))
                    return kept[-1]

                row = worker.run(job, keep)
                if on_progress:
                    on_progress("episodes", done := done + 1, len(wanted))
                if kept[-1].actions:
                    yield kept[-1], _episode(kept[-1], scene, row)


def _episode(env: RecordedEnv, scene: str, row: dict[str, Any]) -> Episode:
    """Return a driven episode as one block."""
    options = plain(env.options or {})
    truncations = np.array(env.truncations)
    truncations[-1] |= not env.terminations[-1]
    names = env.observations[0]
    block = Block(
        {name: np.stack([observation[name] for observation in env.observations]) for name in names},
        np.stack(env.actions),
        np.array(env.rewards, np.float64),
        np.array(env.terminations),
        truncations,
        [plain(info) for info in env.infos],
    )
    metadata = plain({"row": row, "reset": {"seed": env.seed, "options": options}, "keywords": _keywords(env, scene)})
    words = f"{row['env'].removeprefix('vssm_gym/')} in {row['scene']}, task {row['task']}"
    return Episode(words, env.seed, metadata, [block])


def _keywords(env: RecordedEnv, scene: str) -> dict[str, Any]:
    """Return the keywords that the environment was made with; the scene by its name, or the name of its file."""
    spec = env.unwrapped.spec
    assert spec is not None
    named = scene if scene.startswith(PREFIX) else scene_name(scene)
    return plain(spec.kwargs | {"scene": named})


def _description(config: SweepConfig, env: RecordedEnv, episode: Episode) -> Description:
    varied = {name for name in LISTED if len(getattr(config, "scenes" if name == "scene" else name)) > 1}
    row, keywords = episode.metadata["row"], episode.metadata["keywords"]
    assert isinstance(env.observation_space, gym.spaces.Dict)
    limited = env.has_wrapper_attr("_max_episode_steps")  # of Gymnasium's TimeLimit
    return Description(
        source=f"episodes of {config.env[0]}",
        observations=env.observation_space,
        actions=env.action_space,
        rate=float(env.metadata["render_fps"]),
        version=row["version"],
        robot=SWEPT_ENVIRONMENTS[config.env[0]].robot,
        agents=tuple(agent_label(agent) for agent in config.agents),
        env=config.env[0],
        keywords={name: value for name, value in keywords.items() if name not in varied},
        max_episode_steps=int(env.get_wrapper_attr("_max_episode_steps")) if limited else None,
    )
