"""Episodes of a sweep: what identifies one, what it is called in rows and files, and which seed it has."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from vssm_gym.agents.policy.file import agent_label
from vssm_gym.envs.scenes.generator import PREFIX


class ExploreSettings(BaseModel):
    """How explorers run.

    ``steps`` (of 0.2 s) is the time limit of a run; ``navigation`` is how many PointNav tasks ``astar`` then drives on
    the map that the run left.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    steps: Annotated[int, Field(gt=0)] = 1500
    navigation: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True)
class Condition:
    """What all episodes of one simulated world share."""

    env: str
    scene: str  # as the configuration names it
    robot: str
    noise: str
    sensor_noise: str
    renderer: str
    physics: str


@dataclass(frozen=True)
class Episode:
    """One run of one agent at one task of one world."""

    condition: Condition
    task: int
    seed: int  # of the sweep's list; `episode_seed` mixes it with scene and task
    agent: str
    explore: ExploreSettings | None = None  # of an explorer's run

    def identity(self, scene_hash: str) -> dict[str, Any]:
        """The fields of a row that say which episode it is, scenes by their short name and content."""
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
            "task": self.task,
            "seed": self.seed,
            "agent": agent_label(self.agent),
        }


def scene_name(scene: str) -> str:
    """What rows and files call a scene: a built-in name as it is, a seed with dashes, a file by its stem."""
    return scene.replace(":", "-") if scene.startswith(PREFIX) else Path(scene).stem


def episode_seed(seed: int, scene_hash: str, task: int) -> int:
    """The seed of the environment's streams, uint32: of (seed, scene, task) and *not* of the agent.

    Agents so meet the same noise stream on the same task, which is what makes their difference a paired one.
    """
    text = json.dumps([seed, scene_hash, task])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big")
