"""A robot's cell in a scene: arm at its home, gripper, camera's view, obstacles, workspace."""

from collections.abc import Sequence
from itertools import combinations, product
from pathlib import Path

import numpy as np

from limber.cell.arm import Rods
from limber.cell.cell_file import Cell
from limber.cell.known_arms import arm_named
from limber.cell.obstacles import Box, Obstacle, Solid
from limber.cell.reach_and_collision import drawn_arm, drawn_gripper
from limber.core.numerics.rigid import any_normal, matrices
from limber.results.cell_picture import camera_edges
from limber.results.scene.arrays import SceneData

_SIDES, _RINGS = 16, 5
_LINE_M = 0.002  # radius of drawn edges
_COLOURS = {"arm": (0.10, 0.20, 0.32), "tool": (0.02, 0.05, 0.09), "second_arm": (0.43, 0.27, 0.10),
            "camera": (0.43, 0.03, 0.12), "obstacle": (0.32, 0.32, 0.32),
            "workspace": (0.15, 0.07, 0.30)}
_OBSTACLE_ALPHA = 0.35
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
_EDGES = [(a, b) for a, b in combinations(range(8), 2)
          if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 2]
_SIDES_OF_BOX = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                          [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])

_Part = tuple[np.ndarray, np.ndarray]
"""Vertices [v, 3] m and triangles [f, 3]."""


def add_cell(data: SceneData, cell: Cell, obstacles: Sequence[Obstacle]) -> None:
    """Add what a cell file states, each as ``solid:KEY`` and ``solid_faces:KEY``.

    ``info["cell"]`` has title, colour and opacity of each. The arm, with what it carries, is left
    out where the scene shows its dry run; else the picture shows all of it.
    """
    data.info["cell"] = {}
    base = matrices(np.array(cell.base.pose))
    home = np.array(cell.arm.home, float)
    flange = base @ cell.arm.forward(home)
    name = Path(cell.arm.name).stem
    moves = "robot" in data.info
    if not moves:
        _add(data, "arm", f"Arm {name}", _capsules(drawn_arm(cell.arm, home[None], base)))
        _add(data, "tool", "Gripper", _capsules(drawn_gripper(cell, flange[None])))
        _widen_view(data, "arm", "tool")
    if cell.second_arm is not None:
        other = arm_named(cell.second_arm.model)
        _add(data, "second_arm", f"Second arm {Path(other.name).stem}", _capsules(drawn_arm(
            other, np.array([other.home], float), matrices(np.array(cell.second_arm.base_pose)))))
    if cell.camera is not None and not (moves and cell.camera.mount == "flange"):
        _add(data, "camera", "Camera's view", _lines(camera_edges(cell, flange)))
    if cell.workspace is not None:
        low, high = np.array(cell.workspace.low_m), np.array(cell.workspace.high_m)
        corners = 0.5 * (low + high) + 0.5 * (high - low) * _CORNERS
        _add(data, "workspace", "Workspace of the grasp",
             _lines([(corners[a], corners[b]) for a, b in _EDGES]))
    for number, obstacle in enumerate(obstacles):
        _add(data, f"obstacle{number + 1}", f"Obstacle {obstacle.name}", [_surface(obstacle)],
             kind="obstacle", alpha=_OBSTACLE_ALPHA)


def _add(data: SceneData, key: str, title: str, parts: Sequence[_Part], *, kind: str = "",
         alpha: float = 1.0) -> None:
    counts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    data.arrays[f"solid:{key}"] = np.concatenate([vertices for vertices, _ in parts])
    data.arrays[f"solid_faces:{key}"] = np.concatenate(
        [faces + first for (_, faces), first in zip(parts, counts[:-1], strict=True)])
    data.info["cell"][key] = {"title": title, "color": _COLOURS[kind or key], "alpha": alpha}


def _widen_view(data: SceneData, *keys: str) -> None:
    """Have the picture show all of some parts."""
    points = np.vstack([data.arrays[f"solid:{key}"] for key in keys])
    middle, half = 0.5 * (points.max(0) + points.min(0)), 0.5 * np.ptp(points, axis=0)
    seen = data.arrays.get("view_points", np.empty((0, 3)))
    data.arrays["view_points"] = np.vstack([seen, middle + half * _CORNERS])


def _surface(obstacle: Obstacle) -> _Part:
    if isinstance(obstacle, Box):
        return obstacle.centre + (_CORNERS * obstacle.half) @ obstacle.axes, _SIDES_OF_BOX
    assert isinstance(obstacle, Solid)
    return obstacle.surface.vertices, obstacle.surface.faces


def _lines(ends: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[_Part]:
    return [_capsule(start, end, _LINE_M) for start, end in ends]


def _capsules(rods: Rods) -> list[_Part]:
    """Closed surfaces of the rods of one pose, with round ends."""
    return [_capsule(start, end, float(radius)) for start, end, radius in
            zip(rods.starts[0], rods.ends[0], rods.radii, strict=True)]


def _capsule(start: np.ndarray, end: np.ndarray, radius: float) -> _Part:
    vector = end - start
    length = float(np.linalg.norm(vector))
    axis = vector / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    first = any_normal(axis)
    around = 2 * np.pi * np.arange(_SIDES) / _SIDES
    circle = np.outer(np.cos(around), first) + np.outer(np.sin(around), np.cross(axis, first))
    round_end = np.linspace(0.0, 0.5 * np.pi, _RINGS + 1)[:-1]
    rings = [start - radius * np.sin(tilt) * axis + radius * np.cos(tilt) * circle
             for tilt in round_end[::-1]]
    rings += [end + radius * np.sin(tilt) * axis + radius * np.cos(tilt) * circle
              for tilt in round_end]
    poles = [start - radius * axis, end + radius * axis]
    count, k = len(rings), np.arange(_SIDES)
    after = (k + 1) % _SIDES
    quads = [np.concatenate([np.column_stack([k, after, k + _SIDES]),
                             np.column_stack([after, after + _SIDES, k + _SIDES])]) + _SIDES * row
             for row in range(count - 1)]
    low, high = count * _SIDES, (count - 1) * _SIDES
    caps = [np.column_stack([after, k, np.full(_SIDES, low)]),
            np.column_stack([k + high, after + high, np.full(_SIDES, low + 1)])]
    return np.vstack([*rings, poles]), np.concatenate([*quads, *caps])
