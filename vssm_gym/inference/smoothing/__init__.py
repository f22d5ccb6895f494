"""Infer a whole trajectory and the map from all images at once: ``q(z_1:T, M)`` (VSSM-LM)."""
