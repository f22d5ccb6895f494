"""Measure speed, memory and accuracy on one machine: ``vssm-gym bench NAME``, one module a benchmark.

``drive``, ``imagined_replay`` and ``open3d_process`` are parts that benchmarks share. Benchmarks may use every other
part of :mod:`vssm_gym.eval`; only :mod:`vssm_gym.training` and the command line import them.
"""
