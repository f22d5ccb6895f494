"""Score agents, SLAM methods and world models of anyone on frozen tasks: ``vssm-gym benchmark``.

- ``suite``: a suite's file, which is data: tracks, scenes, tasks and their hashes; ``suites`` holds the public ones.
- ``entries``: what a word of the command line refers to, and which tracks that enters.
- ``run``: agents drive in sweeps; ``slam`` and ``prediction`` are run by ``units`` in a process of their own.
- ``manifest``: what the folder of a run states of it; a run goes on with the same entries only.
- ``scores``, ``results``, ``page``: one headline score a track with its interval, ranks, and the results as Markdown.
"""
