"""Repeat the comparisons of the papers on recordings and scenes: ``vssm-gym study NAME``, one module a study.

Each module has a function ``run(...)`` that returns a :class:`~vssm_gym.eval.studies.page.Study`, which ``page``
writes. Studies import no other part of :mod:`vssm_gym.eval`.
"""
