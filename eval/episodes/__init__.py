"""Hold the data of a sweep's episodes.

``identity`` names and seeds them, ``row`` is the schema of their rows, ``log`` reads and writes the rows, and
``manifest`` reads what a sweep states about itself.

This package imports no other part of :mod:`vssm_gym.eval`.
"""
