"""Identify the episodes of a sweep: their fields, their names in rows and files, and their seeds."""

import hashlib
import json
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from vssm_gym.agents.policy.policy_file import agent_label
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.eval.episodes.row import without_defaults


class ExploreSettings(BaseModel):
    """Hold the settings of explorers' runs.

    ``steps`` (of 0.2 s) is the time limit of a run; ``navigation`` is the number of PointNav tasks that ``astar`` then
    drives on the map of the run.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    steps: Annotated[int, Field(gt=0)] = 1500
    navigation: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True)
class Condition:
    """Hold what all episodes of one simulated world share."""

    env: str
    scene: str  # as the configuration names it
    robot: str
    noise: str
    sensor_noise: str
    renderer: str
    physics: str
    direction_frame: str = "body"


@dataclass(frozen=True)
class Episode:
    """Hold one run of one agent at one task of one world."""

    condition: Condition
    task: int
    seed: int  # of the sweep's list; `episode_seed` mixes it with scene and task
    agent: str
    explore: ExploreSettings | None = None  # of an explorer's run

    def identity(self, scene_hash: str) -> dict[str, Any]:
        """Return the fields of a row that identify the episode, scenes by their short name and content."""
        c = self.condition
        return {
            "env": c.env,
            "scene": scene_name(c.scene),
            "scene_hash": scene_hash,
            "robot": c.robot,
            "noise": c.noise,
            "sensor_noise": c.sensor_noise,
            "renderer": c.renderer,
            "physics": c.physics,
            **without_defaults({"direction_frame": c.direction_frame}),
            "task": self.task,
            "seed": self.seed,
            "agent": agent_label(self.agent),
        }

    def words(self) -> str:
        """Return the agent, the scene, the task, the noise and the seed in words, for messages."""
        c = self.condition
        where = f"scene {scene_name(c.scene)}, task {self.task}, noise {c.noise}, seed {self.seed}"
        return f"agent {agent_label(self.agent)}, {where}"


def episode_seed(seed: int, scene_hash: str, task: int) -> int:
    """Return the seed of the environment's streams, uint32: a hash of (seed, scene, task) and *not* of the agent.

    Agents so have the same noise stream on the same task, which makes their differences paired.
    """
    text = json.dumps([seed, scene_hash, task])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big")
