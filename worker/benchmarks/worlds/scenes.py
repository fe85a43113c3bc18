"""What a sensor sees besides wood: leaves, a pot with soil, a stake and a wire."""

from dataclasses import dataclass

import numpy as np

from benchmarks.worlds.plant import Plant, sheet_triangles

WOOD, LEAF, SUPPORT = 0, 1, 2


@dataclass(frozen=True)
class Scene:
    """Triangles [m], shape [t, 3, 3], and what each belongs to (``WOOD``, ...), shape [t]."""

    triangles: np.ndarray
    label: np.ndarray

    @classmethod
    def bare(cls, plant: Plant) -> "Scene":
        skin = plant.skin()
        return cls(skin, np.full(len(skin), WOOD))

    def plus(self, triangles: np.ndarray, label: int) -> "Scene":
        return Scene(np.concatenate([self.triangles, triangles]),
                     np.concatenate([self.label, np.full(len(triangles), label)]))


def leafy(plant: Plant, rng: np.random.Generator) -> Scene:
    """With curved blades on the outer half of the twigs and at all tips."""
    scene = Scene.bare(plant)
    skeleton = plant.skeleton
    depth = skeleton.arc_length
    outer = np.flatnonzero((skeleton.radius < np.median(skeleton.radius))
                           & (depth > 0.3 * depth.max()))
    at = np.concatenate([skeleton.tips(), rng.choice(outer, min(len(outer), int(
        rng.integers(8, 30))), replace=False)])
    for node in at:
        along = skeleton.nodes[node] - skeleton.nodes[skeleton.parent[node]]
        scene = scene.plus(_blade(skeleton.nodes[node], along, rng), LEAF)
    return scene


def potted(plant: Plant, rng: np.random.Generator) -> Scene:
    """In a pot, tied to a stake by a wire."""
    scene = Scene.bare(plant)
    base = plant.nodes[0]
    height, wide = 0.1, rng.uniform(0.05, 0.08)
    pot = _revolved(base, [(0.75 * wide, -height), (wide, 0.02), (wide - 0.004, 0.02),
                           (wide - 0.006, 0.0), (0.0, 0.0)])
    beside = base + [0.6 * wide, 0.0, 0.0]
    top = float(np.ptp(plant.nodes[:, 2])) * rng.uniform(0.5, 0.8)
    stake = _revolved(beside, [(0.005, 0.0), (0.005, top), (0.0, top)])
    stem = plant.nodes[int(np.argmin(np.abs(plant.nodes[:, 2] - base[2] - 0.5 * top)
                                     + np.linalg.norm(plant.nodes[:, :2] - base[:2], axis=1)))]
    wire = Plant(np.linspace(beside + [0, 0, 0.5 * top], stem, 12), np.arange(-1, 11),
                 np.full(12, 0.001))
    return scene.plus(np.concatenate([pot, stake, wire.skin()]), SUPPORT)


def _blade(at: np.ndarray, along: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A leaf with a stalk's gap of 4 mm, arched along and across."""
    along = along / max(float(np.linalg.norm(along)), 1e-9) + 0.8 * rng.normal(size=3)
    along /= np.linalg.norm(along)
    across = np.cross(along, rng.normal(size=3))
    across /= np.linalg.norm(across)
    long, wide = rng.uniform(0.03, 0.09), rng.uniform(0.01, 0.03)
    u, v = np.meshgrid(np.linspace(0, 1, 12), np.linspace(-1, 1, 7), indexing="ij")
    width = wide * np.sin(np.pi * np.clip(u, 0.02, 0.98))**0.8 * v
    rise = -0.3 * long * u**2 + 0.25 * wide * v**2
    grid = (at + 0.004 * along + long * u[..., None] * along + width[..., None] * across
            + rise[..., None] * np.cross(along, across))
    return sheet_triangles(grid)


def _revolved(base: np.ndarray, profile: list[tuple[float, float]]) -> np.ndarray:
    """A profile of (radius, height) [m] turned about the vertical through ``base``."""
    angle = np.linspace(0, 2 * np.pi, 33)[:-1]
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(32)], axis=1)
    dense = np.array(profile)
    return sheet_triangles(np.array([base + radius * ring + [0, 0, height]
                                     for radius, height in dense]), closed=True)
