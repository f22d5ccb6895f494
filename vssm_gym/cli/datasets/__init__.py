"""Run ``vssm-gym dataset NAME``."""
