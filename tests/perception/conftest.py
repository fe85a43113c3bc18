"""A bent branch whose axis is known, seen by a simulated depth camera."""

import numpy as np
import pytest

from limber.geometry.cloud.camera import D455
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tree_sweep import curved_beam
from limber.perception.simulated_camera import render_depth, with_noise

LENGTH, NODES = 0.6, 81
FRACTIONS = (0.2, 0.4, 0.6, 0.8)


def axis(bend: float, twist: float = 0.0) -> np.ndarray:
    """A curve of constant length whose direction turns along it, shape [81, 3]."""
    s = np.linspace(0.0, 1.0, NODES)
    angle = 0.3 * s + bend * s + 0.4 * bend * s**2
    tangent = np.column_stack([np.sin(angle) * np.cos(twist * s),
                               np.sin(angle) * np.sin(twist * s), np.cos(angle)])
    steps = (tangent[1:] + tangent[:-1]) / 2 * LENGTH / (NODES - 1)
    return np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])


class Scene:
    """The branch, a camera, and what it would see."""

    radius = np.linspace(6e-3, 2e-3, NODES)

    def __init__(self):
        self.skeleton = Skeleton.from_edges(axis(0.0), np.arange(-1, NODES - 1), self.radius)
        self.camera = D455.looking(eye=np.array([0.1, -1.0, 0.3]), target=np.array([0.1, 0, 0.3]))

    def depth(self, bend: float, rng: np.random.Generator | None, **noise: float) -> np.ndarray:
        mesh = curved_beam(axis(bend, bend / 2), self.radius, sides=10, quadratic=False)
        image = render_depth(self.camera, mesh.nodes, mesh.surface_faces())
        return image if rng is None else with_noise(self.camera, image, rng, **noise)

    def control_points(self, bend: float) -> np.ndarray:
        s = np.linspace(0.0, 1.0, NODES)
        return np.column_stack([np.interp(FRACTIONS, s, row) for row in axis(bend, bend / 2).T])


@pytest.fixture(scope="session")
def scene() -> Scene:
    return Scene()
