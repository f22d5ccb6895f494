"""State what a sweep is: its configuration and scenes, the hashes of what determines its results, and the version."""

import hashlib
import json
from pathlib import Path
from typing import Any

from vssm_gym.agents.policy.policy_file import agent_label
from vssm_gym.agents.renamed import hashed_name
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.eval.episodes.row import without_defaults
from vssm_gym.eval.protocols.given_tasks import task_file_hash
from vssm_gym.eval.protocols.registry import protocol_of
from vssm_gym.eval.sweep.config import SweepConfig
from vssm_gym.eval.sweep.given_map import given_map_hash
from vssm_gym.eval.sweep.own_agents import code_hashes, own_agents
from vssm_gym.eval.sweep.shards import Part
from vssm_gym.version import package_version


def config_hash(config: SweepConfig, scene_hashes: dict[str, str], seed: int) -> str:
    """Hash what determines the results (configuration, scenes, policies, own agents' code, seed); 16 hex digits."""
    content = _stated(config)
    if config.explore is None:
        del content["explore"]
    content |= {"scenes": [scene_hashes[s] for s in config.scenes], "seed": seed}
    content["agents"] = [hashed_name(agent_label(agent)) for agent in config.agents]
    if codes := code_hashes(own_agents(config.agents)):
        content["agent_code"] = codes
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _stated(config: SweepConfig) -> dict[str, Any]:
    """Return the fields of a configuration, fields that came later only where they differ from what was before them."""
    content = without_defaults(config.model_dump(mode="json"))
    if config.map_surfaces == "learned":
        del content["map_surfaces"]
    if config.task_file is None:
        del content["task_file"]
    else:
        content["task_file"] = task_file_hash(Path(config.task_file))
    return content


def manifest_of(
    config: SweepConfig,
    apartments: dict[str, Apartment],
    seed: int,
    episodes: int,
    shard: Part | None = None,
    map_file: Path | None = None,
) -> dict[str, Any]:
    """Return the content of a sweep's manifest; with ``map_file``, of a sweep whose agents are given this map."""
    hashes = {scene: apartment.content_hash() for scene, apartment in apartments.items()}
    codes = code_hashes(own_agents(config.agents))
    protocol = protocol_of(config.env[0])
    shown = _stated(config) | {
        "scenes": [scene_name(scene) for scene in config.scenes],
        "agents": [agent_label(agent) for agent in config.agents],
    }
    return {
        "config": shown,
        "config_hash": config_hash(config, hashes, seed),
        "scene_hashes": {scene_name(scene): content for scene, content in hashes.items()},
        "notices": {scene_name(scene): protocol.notice(apartment) for scene, apartment in apartments.items()},
        "version": package_version(),
        "seed": seed,
        "episodes": episodes,
        **({"shard": shard.stated()} if shard else {}),
        **({"agent_code": codes} if codes else {}),
        **({"map_hash": given_map_hash(config, map_file)} if map_file else {}),
    }
