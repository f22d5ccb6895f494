"""Write the report of a sweep as one HTML page.

``page`` assembles it from ``tables``, ``figures`` and the ``view`` of an environment; ``car``, ``explore`` and
``lidar_maze`` define the views that differ from PointNav's, with tables and figures of their own. ``summary`` formats
the table that a sweep prints. Of :mod:`vssm_gym.eval` this package imports ``episodes``, ``metrics`` and ``protocols``.
"""
