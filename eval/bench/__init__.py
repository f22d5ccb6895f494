"""Benchmarks: ``vssm-gym bench``."""
