"""Infer a pose from a single scan: an encoder ``q(z | x)``, trained against a frozen model of scans, and its mode."""
