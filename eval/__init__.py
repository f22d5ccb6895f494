"""Evaluation: metrics, sweeps, aggregation, reports and benchmarks."""
