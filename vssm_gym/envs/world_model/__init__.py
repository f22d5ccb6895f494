"""``vssm_gym/WorldModelNav-v0``: navigation inside a learned map. Docs: ``docs/envs/world_model_nav.md``.

From the parts to the whole: ``config`` (what may be chosen), ``rays`` and ``view`` (what is seen), ``ground`` (what is
collided with), ``ways`` and ``tasks`` (starts, goals, and how far they are), ``motion`` (how robots move), ``world``
(all of that, built once), ``step`` (one compiled step for many robots), ``vector`` and ``single`` (Gymnasium).
"""
