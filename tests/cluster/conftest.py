"""Start one Ray cluster for the tests of this folder."""

from collections.abc import Iterator

import pytest

from tests.helpers.sweeps.ray_nodes import Nodes, two_nodes


@pytest.fixture(scope="session")
def nodes() -> Iterator[Nodes]:
    """Run two nodes; a test that kills one starts its own."""
    pytest.importorskip("ray")
    with two_nodes() as started:
        yield started
