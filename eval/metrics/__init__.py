"""Compute metrics of episodes and maps, and means with 95 % intervals.

``metric`` and ``registry`` define the metrics of an episode's row, ``navigation``, ``exploration``, ``surfaces``,
``collision_rate``, ``pose_calibration`` and ``failure`` compute their values, ``aggregate`` and ``proportions`` their
means, paired differences and intervals. Of :mod:`vssm_gym.eval` this package imports ``episodes`` only.
"""
