"""The pull of the small branch without a cell, and the objective that tests of forces fit."""

import pytest
from tests.subjects.forced_pulls import SETTINGS, without_cell


@pytest.fixture(scope="module")
def pull(small_pull):
    return without_cell(small_pull)


@pytest.fixture(scope="module")
def objective(small_bench, pull):
    return small_bench.objective([pull], SETTINGS)
