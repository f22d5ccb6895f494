"""Evaluate agents: run them in sweeps of episodes, compute metrics with intervals, write reports, and benchmark.

Sub-packages, each of which may import the ones before it:

- ``episodes``: identity, row, log and manifest: the data that a sweep keeps.
- ``metrics``: metrics of episodes and maps, means and paired differences with intervals.
- ``protocols``: one module an environment that sets its tasks and runs its episodes.
- ``sweep``: configurations, worker processes, shards.
- ``report``: the HTML page of a sweep, its tables and figures.
- ``video``: pictures and videos of single runs.
- ``bench``, ``studies`` and ``faults``: measurements on one machine, the comparisons of the papers, and runs with
  faulty images.
- ``benchmark``: frozen suites for the entries of anyone.

``configs`` and ``baselines`` hold the committed configurations and the rows of the published sweeps.
"""
