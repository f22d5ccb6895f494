"""Run a small sweep once for all tests whose rows are run again.

What compiles is imported by the fixture: pytest may read this file before ``tests/conftest.py`` has set up XLA.
"""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a sweep of six episodes, which no test writes to."""
    from tests.helpers.sweeps.finished_sweep import DIST_BUG
    from vssm_gym.eval.sweep.runner import run_sweep

    folder = tmp_path_factory.mktemp("sweep") / "out"
    run_sweep(DIST_BUG, folder, workers=1)
    return folder
