"""Warming up compiles what planning needs, and runs in a second where it is compiled."""

import pytest

from limber.planning.planners.rrt_star import _grow
from limber.planning.warm_up import warm_up


@pytest.mark.slow
def test_warm_up_compiles_the_planner():
    """After it the tree's loop exists as machine code."""
    warm_up()
    assert _grow.signatures
