"""Every agent by name; the command line, sweeps and tests read this table and nothing else."""

from vssm_gym.agents.astar import AStarAgent
from vssm_gym.agents.base import Agent
from vssm_gym.agents.dead_reckoning import DeadReckoningAgent
from vssm_gym.agents.no_map import NoMapAgent
from vssm_gym.agents.oracle import OracleAgent
from vssm_gym.agents.random import RandomAgent

AGENTS: dict[str, type[Agent]] = {
    agent.name: agent for agent in (AStarAgent, NoMapAgent, DeadReckoningAgent, OracleAgent, RandomAgent)
}
