"""Name the programs that optimise a graph: GTSAM's where it is installed, and a second one that is always there."""

import importlib.util
import sys
from pathlib import Path

import pytest

from vssm_gym.eval.studies.scan_graph.graph import GTSAM_COMMAND

LEAST_SQUARES = (sys.executable, str(Path(__file__).with_name("least_squares.py")))
needs_gtsam = pytest.mark.skipif(importlib.util.find_spec("gtsam") is None, reason="GTSAM is not installed")
OPTIMISERS = [
    pytest.param(GTSAM_COMMAND, marks=needs_gtsam, id="gtsam"),
    pytest.param(LEAST_SQUARES, id="least squares"),
]
