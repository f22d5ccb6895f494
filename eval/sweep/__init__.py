"""Run sweeps: all episodes of a configuration over worker processes.

``config`` reads and checks a configuration, ``runner`` runs it, ``worker`` is one process, ``shards`` and ``merge``
split a sweep over machines. Of :mod:`vssm_gym.eval` this package imports ``episodes`` and ``protocols``.
"""
