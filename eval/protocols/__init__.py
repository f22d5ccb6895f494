"""Set, run and evaluate the episodes of each environment: one module a protocol.

``registry`` defines the interface and finds the protocol of an environment; ``pointnav`` (also ImageNav), ``carnav``,
``explore`` and ``lidar_maze`` implement it. ``episode`` and ``explore_episode`` are the loops over steps,
``agent_context`` builds what agents receive, ``shared`` caches scenes and environments. Of :mod:`vssm_gym.eval` this
package imports ``episodes`` and ``metrics``.
"""
