"""List every agent by name; the command line, sweeps and tests read this table and nothing else."""

import inspect
from dataclasses import replace
from typing import Any

from vssm_gym.agents.base import AGENT_ROBOTS, AGENT_TASKS, Agent
from vssm_gym.agents.car.dwa import DwaAgent
from vssm_gym.agents.car.greedy import GreedyAgent
from vssm_gym.agents.car.hybrid_astar import HybridAStarAgent
from vssm_gym.agents.car.slam_car import SlamCarAgent
from vssm_gym.agents.car.vi_ipopt import ViIpoptAgent
from vssm_gym.agents.car.vi_mpc import ViMpcAgent
from vssm_gym.agents.car.vi_mpc_estimated_pose import ViMpcEstimatedPoseAgent
from vssm_gym.agents.car.vi_mppi import ViMppiAgent
from vssm_gym.agents.exploration.frontier_gain import FrontierGainAgent
from vssm_gym.agents.exploration.frontier_gain_estimated_pose import FrontierGainEstimatedPoseAgent
from vssm_gym.agents.exploration.frontier_gain_scan import FrontierGainScanAgent
from vssm_gym.agents.exploration.frontier_gain_scan_estimated_pose import FrontierGainScanEstimatedPoseAgent
from vssm_gym.agents.exploration.frontier_nearest import FrontierNearestAgent
from vssm_gym.agents.exploration.mi_explorer import MiExplorerAgent
from vssm_gym.agents.exploration.mi_explorer_estimated_pose import MiExplorerEstimatedPoseAgent
from vssm_gym.agents.exploration.random_viewpoint import RandomViewpointAgent
from vssm_gym.agents.exploration.random_walk import RandomWalkAgent
from vssm_gym.agents.navigation.astar import AStarAgent
from vssm_gym.agents.navigation.astar_image import AStarImageAgent
from vssm_gym.agents.navigation.dead_reckoning import DeadReckoningAgent
from vssm_gym.agents.navigation.dist_bug import DistBugAgent
from vssm_gym.agents.navigation.no_map import NoMapAgent
from vssm_gym.agents.navigation.oracle import OracleAgent
from vssm_gym.agents.navigation.random import RandomAgent
from vssm_gym.agents.navigation.scan_astar import ScanAStarAgent
from vssm_gym.agents.navigation.scan_astar_latent import ScanAStarLatentAgent
from vssm_gym.agents.navigation.scan_goal import ScanGoalAgent
from vssm_gym.agents.navigation.scan_goal_search import ScanGoalSearchAgent
from vssm_gym.agents.navigation.scan_oracle import ScanOracleAgent
from vssm_gym.agents.navigation.slam_image import SlamImageAgent
from vssm_gym.agents.navigation.slam_nav import SlamNavAgent
from vssm_gym.agents.navigation.slam_nav_ablations import (
    FrontierNavAgent,
    SlamNavKnownSpaceAgent,
    SlamNavNoRecoveryAgent,
    SlamNavNoUncertaintyAgent,
    SlamNavTruePoseAgent,
)
from vssm_gym.agents.policy.agent import PolicyAgent
from vssm_gym.agents.policy.policy_file import PREFIX
from vssm_gym.agents.renamed import refuse_former
from vssm_gym.errors import InputError, one_of
from vssm_gym.planning.planners import find_planner

AGENTS: dict[str, type[Agent]] = {
    agent.name: agent
    for agent in (
        AStarAgent,
        AStarImageAgent,
        SlamImageAgent,
        NoMapAgent,
        DeadReckoningAgent,
        OracleAgent,
        SlamNavAgent,
        SlamNavTruePoseAgent,
        SlamNavKnownSpaceAgent,
        SlamNavNoRecoveryAgent,
        SlamNavNoUncertaintyAgent,
        FrontierNavAgent,
        RandomAgent,
        ViMpcAgent,
        ViIpoptAgent,
        ViMppiAgent,
        ViMpcEstimatedPoseAgent,
        SlamCarAgent,
        HybridAStarAgent,
        GreedyAgent,
        DwaAgent,
        DistBugAgent,
        ScanAStarAgent,
        ScanAStarLatentAgent,
        ScanGoalAgent,
        ScanGoalSearchAgent,
        ScanOracleAgent,
        MiExplorerAgent,
        FrontierNearestAgent,
        FrontierGainAgent,
        FrontierGainScanAgent,
        RandomViewpointAgent,
        RandomWalkAgent,
        MiExplorerEstimatedPoseAgent,
        FrontierGainEstimatedPoseAgent,
        FrontierGainScanEstimatedPoseAgent,
    )
}
BUILT_IN = frozenset(AGENTS)
FIXED = ("robot", "task", "needs_pose", "needs_map", "end_on")  # what a class states, and its instances share
ATTRIBUTES = ("name", "robot", "task", "needs_pose", "needs_map", "reset", "act")  # of every agent's class

WITH = "+"  # between a navigating agent and its planner: ``astar+theta_star``


def agent_type(name: str) -> type[Agent]:
    """Return the class of an agent of the table, with any planner, or of ``policy:FILE``.

    Raises:
        InputError: an agent or a planner that is not registered, a former name, a planner for an agent that takes none.
    """
    if name.startswith(PREFIX):
        return PolicyAgent
    base, named, planner = name.partition(WITH)
    if named:
        takers = [agent for agent, kind in AGENTS.items() if hasattr(kind, "navigation")]
        if base not in takers:
            raise InputError("agent", name, f"a planner after one of {', '.join(takers)}")
        find_planner(planner)
    refuse_former(base, "agent", "name")
    if base not in AGENTS:
        raise InputError("agent", "name", one_of(AGENTS, base))
    return AGENTS[base]


def register_agent(kind: type[Agent]) -> type[Agent]:
    """Add an agent to those of sweeps and commands, under its ``name``; also a decorator.

    Sweeps run in worker processes, which import the program that started them: define the class at the top level of a
    file, and start the sweep below ``if __name__ == "__main__"``.

    Args:
        kind: the agent's class, which is called without arguments.

    Returns:
        The class.

    Raises:
        InputError: the class lacks what :class:`vssm_gym.agents.base.Agent` states; another agent has that name.
    """
    _check_agent(kind)
    other = AGENTS.get(kind.name, kind)
    if other is not kind and (kind.name in BUILT_IN or other.__qualname__ != kind.__qualname__):
        raise InputError("register_agent", "name", f"one that no other agent has; found {kind.name!r}")
    AGENTS[kind.name] = kind
    return kind


def _check_agent(kind: Any) -> None:
    """Raise :class:`InputError` unless a class has the attributes of an agent."""
    if not isinstance(kind, type):
        raise InputError("register_agent", "kind", f"the class of an agent; found {type(kind).__name__}")
    source = f"agent {kind.__name__}"
    if missing := [attribute for attribute in ATTRIBUTES if not hasattr(kind, attribute)]:
        found = f"the class attributes {', '.join(ATTRIBUTES)}; {', '.join(missing)} missing"
        raise InputError(source, missing[0], found)
    stated = {attribute: getattr(kind, attribute) for attribute in ATTRIBUTES}
    name = stated["name"]
    if not isinstance(name, str) or not name.isprintable() or not name or WITH in name or name.startswith(PREFIX):
        raise InputError(source, "name", f"a printable name without {WITH!r} and {PREFIX!r}; found {name!r:.100}")
    for attribute, values in (("robot", AGENT_ROBOTS), ("task", AGENT_TASKS)):
        if (found := stated[attribute]) not in values:
            raise InputError(source, attribute, f"one of {', '.join(values)}; its {attribute} is {found!r:.100}")
    for attribute in ("needs_pose", "needs_map"):
        if not isinstance(found := stated[attribute], bool):
            raise InputError(source, attribute, f"True or False; found {found!r:.100}")
    for attribute in ("reset", "act"):
        if not callable(found := stated[attribute]):
            raise InputError(source, attribute, f"a method; found {found!r:.100}")
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    parameters = [p for p in inspect.signature(kind).parameters.values() if p.kind not in variable]
    needed = [p.name for p in parameters if p.default is p.empty]
    if needed:
        raise InputError(source, "__init__", f"no argument without a default; {', '.join(needed)} has none")


def make_agent(name: str) -> Agent:
    """Make an agent by name.

    Args:
        name: a name of :data:`AGENTS`; with another planner ``astar+theta_star``; or ``policy:FILE``, a trained policy.

    Returns:
        The agent; ``reset`` opens an episode.

    Raises:
        InputError: an unknown agent or planner, an agent that takes none, a policy file that cannot be read, or one
            that states something else than its class of its robot, its task or what it needs.
    """
    kind: Any = agent_type(name)
    if name.startswith(PREFIX):
        return kind(name.removeprefix(PREFIX))
    planner = name.partition(WITH)[2]
    agent: Agent = kind(replace(kind.navigation, planner=planner)) if planner else kind()
    for attribute in FIXED:
        of_class, own = (getattr(one, attribute, None) for one in (kind, agent))
        if own != of_class:
            expected = (
                f"{of_class!r}, as its class has it, where it is read before the agent is made; found {own!r:.100}"
            )
            raise InputError(f"agent {kind.__name__}", attribute, expected)
    return agent
