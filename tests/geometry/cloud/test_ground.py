"""Ground, rough and on a slope, is cut out of a scan; what has no ground loses nothing."""

import numpy as np
import pytest

from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.preparation import PreparationSettings, prepare
from limber.geometry.cloud.surroundings import find_ground
from limber.geometry.generated import generate_branch

UP = np.array([0.0, 0.0, 1.0])


def scene(slope: float, bump: float, size: float = 0.9) -> tuple[np.ndarray, np.ndarray]:
    """Points of a plant on ground, and which are ground's."""
    rng = np.random.default_rng(4)
    plant = generate_branch(7, length=0.6, fork_count=3, point_spacing=0.004).cloud.points
    flat = rng.uniform(-size / 2, size / 2, (9000, 2))
    waves = rng.normal(0, 12.0, (8, 2))
    height = bump * np.sin(flat @ waves.T + rng.uniform(0, 6, 8)).mean(axis=1) * 2
    height += np.tan(np.deg2rad(slope)) * flat[:, 0] + rng.normal(0, 0.2 * bump + 1e-3, len(flat))
    ground = np.column_stack([flat, height + 0.005])
    return np.vstack([plant, ground]), np.arange(len(plant) + 9000) >= len(plant)


@pytest.mark.parametrize(("slope", "bump"), [(0, 0.0), (0, 0.015), (20, 0.015), (30, 0.005)])
def test_rough_ground_on_a_slope_goes_and_the_plant_stays(slope: float, bump: float) -> None:
    """Over 97 % of the ground, and of the plant nothing but its foot."""
    points, truth = scene(slope, bump)
    found = find_ground(points, UP, 0.08 * len(points))
    assert found[truth].mean() > 0.97
    foot = points[:, 2] < 0.08
    assert not found[~truth & ~foot].any()
    prepared = prepare(Cloud(points), 1.0, PreparationSettings(), up=UP)
    cut = prepared.counts.get("ground", 0) + prepared.counts.get("sheets", 0)
    assert 0.95 * truth.sum() < cut < truth.sum() + foot[~truth].sum()
    assert any("ground" in text for text in prepared.warnings)


def test_plants_without_ground_lose_nothing() -> None:
    """A branch, a bush of many, and a wide flat crown have none."""
    rng = np.random.default_rng(0)
    one = generate_branch(7, length=0.6, fork_count=5, point_spacing=0.004).cloud.points
    bush = np.vstack([one @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T for _ in range(6)])
    crown = rng.uniform([-0.5, -0.5, 0.3], [0.5, 0.5, 0.6], (20_000, 3))
    for points in (one, bush, np.vstack([one, crown])):
        assert find_ground(points, UP, 0.08 * len(points)) is None
