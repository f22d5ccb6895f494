"""Run ``vssm-gym study NAME``."""
