"""Imagine navigation inside a learned map: ``vssm_gym/WorldModelNav-v0``. Docs: ``docs/envs/world_model_nav.md``.

Modules, from the parts to the whole: ``config`` (keywords), ``rays``, ``scan_table``, ``column_bounds`` and ``view``
(rendering), ``collision_map`` (collisions), ``goal_distance`` and ``tasks`` (starts, goals, shortest paths), ``motion``
(dynamics), ``world`` (all arrays of one imagined world, built once), ``step`` (one compiled step for many robots),
``batch_slices`` (many robots on several cores), ``vector`` and ``single`` (Gymnasium), ``picture`` (drawing).
"""
