"""Analytic energy fields, as if a branch model had been asked: no finite elements here."""

from dataclasses import dataclass

import numpy as np
import pytest

from limber.planning.field import GraspSamples, fit_field

STIFFNESS = np.array([8.0, 8.0, 30.0])  # [N/m] soft to the sides, stiff along the branch
SIDE = np.array([0.02, 0.02, 0.0])  # [m] where the ridge stands


@dataclass(frozen=True)
class AnalyticBranch:
    """A quadratic well about the origin, and a Gaussian ridge of ``height`` [J] beside it."""

    height: float
    width: float = 0.05

    def energy(self, points):
        """Energy [J] at ``points`` [n, 3]."""
        return 0.5 * (points**2 @ STIFFNESS) + self._bump(points)

    def force(self, points):
        """Its gradient [N]."""
        bump = self._bump(points)[:, None]
        return points * STIFFNESS - 2 * (points - SIDE) * bump / self.width**2

    def samples(self, *, count=150, radius=0.2, seed=0, rejected=()):
        """Samples in a ball; the tip moves 1.5 times as far as the grasp, from 0.3 m above."""
        generator = np.random.default_rng(seed)
        direction = generator.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        points = direction * (radius * generator.uniform(size=(count, 1)) ** (1 / 3))
        points[0] = 0.0
        rotation = np.stack([-points[:, 1], points[:, 0], 0 * points[:, 0]], axis=1)
        energies = self.energy(points)
        return GraspSamples(
            np.hstack([points, rotation]), energies, energies, self.force(points),
            1.5 * points + [0.0, 0.0, 0.3], np.full(count, 0.95),
            np.asarray(rejected, float).reshape(-1, 6))

    def _bump(self, points):
        return self.height * np.exp(-((points - SIDE) ** 2).sum(axis=1) / self.width**2)


@pytest.fixture(scope="session")
def well():
    return AnalyticBranch(0.0)


@pytest.fixture(scope="session")
def ridge():
    return AnalyticBranch(0.4)


@pytest.fixture(scope="session")
def well_field(well):
    return fit_field(well.samples(count=60))


@pytest.fixture(scope="session")
def ridge_field(ridge):
    return fit_field(ridge.samples())
