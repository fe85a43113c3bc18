"""Branches and scans that several geometry tests share."""

from pathlib import Path

import numpy as np
import pytest

from limber.geometry.cloud.cloud import Cloud
from limber.geometry.generated import generate_branch
from limber.geometry.skeleton.skeleton import Skeleton


@pytest.fixture(scope="session")
def forked_branch():
    """A generated branch with two twigs, scanned from all around with 1 mm of noise."""
    return generate_branch(3, fork_count=2, length=0.6, point_spacing=0.0025)


@pytest.fixture(scope="session")
def coffeetree(recorded_data) -> Path:
    """The laser scan of a coffee tree's branch [m], in map coordinates."""
    return recorded_data / "coffeetree_branch" / "branch.xyz"


@pytest.fixture(scope="session")
def tomato_draws(recorded_data) -> np.ndarray:
    """Four draws of 1,500 points [mm] of a scanned tomato seedling with leaves, [4, 1500, 3]."""
    with np.load(recorded_data / "tomato" / "tomato_03-05.npz") as file:
        return file["draws_mm"].astype(float)


@pytest.fixture(scope="session")
def tomato(tomato_draws) -> Cloud:
    """All points of the draws [mm], once each."""
    return Cloud(np.unique(tomato_draws.reshape(-1, 3), axis=0))


@pytest.fixture
def y_skeleton() -> Skeleton:
    """A straight stem along z with one twig at half its height."""
    stem = np.column_stack([np.zeros(11), np.zeros(11), np.linspace(0, 0.5, 11)])
    twig = stem[5] + np.linspace(0.04, 0.2, 5)[:, None] * np.array([0.8, 0, 0.6])
    return Skeleton.from_edges(
        np.vstack([stem, twig]), np.concatenate([np.arange(11) - 1, [5, 11, 12, 13, 14]]),
        np.concatenate([np.linspace(0.012, 0.008, 11), np.full(5, 0.006)]))
