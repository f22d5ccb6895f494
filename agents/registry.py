"""Every agent by name; the command line, sweeps and tests read this table and nothing else."""

from vssm_gym.agents.astar import AStarAgent
from vssm_gym.agents.base import Agent
from vssm_gym.agents.candidate_random import CandidateRandomAgent
from vssm_gym.agents.dead_reckoning import DeadReckoningAgent
from vssm_gym.agents.dist_bug import DistBugAgent
from vssm_gym.agents.dwa import DwaAgent
from vssm_gym.agents.frontier_gain import FrontierGainAgent
from vssm_gym.agents.frontier_gain_tracked import FrontierGainTrackedAgent
from vssm_gym.agents.frontier_looking import FrontierLookingAgent
from vssm_gym.agents.frontier_looking_tracked import FrontierLookingTrackedAgent
from vssm_gym.agents.frontier_nearest import FrontierNearestAgent
from vssm_gym.agents.greedy import GreedyAgent
from vssm_gym.agents.hybrid_astar import HybridAStarAgent
from vssm_gym.agents.mi_explorer import MiExplorerAgent
from vssm_gym.agents.mi_explorer_tracked import MiExplorerTrackedAgent
from vssm_gym.agents.no_map import NoMapAgent
from vssm_gym.agents.oracle import OracleAgent
from vssm_gym.agents.policy import PolicyAgent
from vssm_gym.agents.policy_file import PREFIX
from vssm_gym.agents.random import RandomAgent
from vssm_gym.agents.random_walk import RandomWalkAgent
from vssm_gym.agents.vi_ipopt import ViIpoptAgent
from vssm_gym.agents.vi_mpc import ViMpcAgent
from vssm_gym.agents.vi_mpc_tracked import ViMpcTrackedAgent
from vssm_gym.agents.vi_mppi import ViMppiAgent

AGENTS: dict[str, type[Agent]] = {
    agent.name: agent
    for agent in (
        AStarAgent,
        NoMapAgent,
        DeadReckoningAgent,
        OracleAgent,
        RandomAgent,
        ViMpcAgent,
        ViIpoptAgent,
        ViMppiAgent,
        ViMpcTrackedAgent,
        HybridAStarAgent,
        GreedyAgent,
        DwaAgent,
        DistBugAgent,
        MiExplorerAgent,
        FrontierNearestAgent,
        FrontierGainAgent,
        FrontierLookingAgent,
        CandidateRandomAgent,
        RandomWalkAgent,
        MiExplorerTrackedAgent,
        FrontierGainTrackedAgent,
        FrontierLookingTrackedAgent,
    )
}


def agent_type(name: str) -> type[Agent]:
    """The class of an agent of the table, or of ``policy:FILE``."""
    return PolicyAgent if name.startswith(PREFIX) else AGENTS[name]


def make_agent(name: str) -> Agent:
    """An agent of the table, or the policy of a file (``policy:FILE``)."""
    return PolicyAgent(name.removeprefix(PREFIX)) if name.startswith(PREFIX) else AGENTS[name]()
