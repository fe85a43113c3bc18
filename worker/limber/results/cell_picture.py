"""A drawing of a cell: arm, gripper, branch, camera, obstacles, from three sides."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, product
from typing import TYPE_CHECKING

import numpy as np

from limber.cell.arm import Rods
from limber.cell.cell_file import Cell
from limber.cell.known_arms import arm_named
from limber.cell.obstacles import Box, Obstacle, Solid
from limber.cell.reach_and_collision import drawn_arm, drawn_gripper
from limber.core.numerics.rigid import matrices
from limber.geometry.skeleton.skeleton import Skeleton

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_VIEWS = (("from the front", 0, 2), ("from the side", 1, 2), ("from above", 0, 1))
_ARM, _SECOND, _TOOL, _BRANCH = "#5b7c99", "#b08d57", "#24425c", "#1f6f43"
_CAMERA, _OBSTACLE, _WORKSPACE = "#b03060", "#9a9a9a", "#6a4c93"
_SHOWN_VIEW_M = 1.0  # of a camera's range that is drawn
_AXIS_M = 0.15  # length of the drawn axes of a frame
_ROUND = np.linspace(0.0, np.pi, 13)


def cell_picture(cell: Cell, joints: np.ndarray, obstacles: Sequence[Obstacle],
                 skeleton: Skeleton | None) -> Figure:
    """Return the drawing of a cell with the arm at ``joints`` [rad], the cell's obstacles, branch
    frame, and the branch's axes; without skeleton only the branch's frame is drawn."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15.0, 6.0), layout="constrained")
    for axes, (title, across, up) in zip(figure.subplots(1, 3), _VIEWS, strict=True):
        axes.set(title=title, xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[up]} [m]",
                 aspect="equal", adjustable="datalim")
        axes.grid(alpha=0.25)
        _draw(axes, [across, up], cell, joints, obstacles, skeleton)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    return figure


def _draw(axes: Axes, seen: list[int], cell: Cell, joints: np.ndarray,
          obstacles: Sequence[Obstacle], skeleton: Skeleton | None) -> None:
    for number, obstacle in enumerate(obstacles):
        _obstacle(axes, seen, obstacle, "obstacles" if number == 0 else None)
    base = matrices(np.array(cell.base.pose))
    if cell.second_arm is not None:
        other = arm_named(cell.second_arm.model)
        _rods(axes, seen, drawn_arm(other, np.array([other.home], float),
                                    matrices(np.array(cell.second_arm.base_pose))), _SECOND,
              f"second arm ({other.name}) at its home")
    _rods(axes, seen, drawn_arm(cell.arm, joints[None], base), _ARM, f"arm ({cell.arm.name})")
    flange = base @ cell.arm.forward(joints)
    _rods(axes, seen, drawn_gripper(cell, flange[None]), _TOOL, "gripper")
    if skeleton is not None:
        _branch(axes, seen, skeleton)
    if cell.camera is not None:
        _camera(axes, seen, cell, flange)
    if cell.workspace is not None:
        low, high = (np.array(part)[seen] for part in (cell.workspace.low_m, cell.workspace.high_m))
        outline = np.array([low, (high[0], low[1]), high, (low[0], high[1]), low])
        axes.plot(*outline.T, "--", color=_WORKSPACE, linewidth=1.0, label="workspace of the grasp")
    for name, frame, side in (("base", base, "left"), ("branch", np.eye(4), "right")):
        _frame(axes, seen, frame, name, side)


def _rods(axes: Axes, seen: list[int], rods: Rods, colour: str, label: str) -> None:
    from matplotlib.collections import PolyCollection

    outlines = [_outline(start[seen], end[seen], radius) for start, end, radius in
                zip(rods.starts[0], rods.ends[0], rods.radii, strict=True)]
    axes.add_collection(PolyCollection(outlines, facecolors=colour, edgecolors="white",
                                       linewidths=0.6, alpha=0.85, zorder=3, label=label))
    axes.update_datalim(np.concatenate(outlines))
    axes.autoscale_view()


def _outline(start: np.ndarray, end: np.ndarray, radius: float) -> np.ndarray:
    """Outline of a capsule between two places [2] of a view, shape [n, 2]."""
    axis = end - start
    turn = np.arctan2(axis[1], axis[0]) if np.linalg.norm(axis) > 0 else 0.0
    ends = []
    for place, first in ((end, turn - 0.5 * np.pi), (start, turn + 0.5 * np.pi)):
        angles = first + _ROUND
        ends.append(place + radius * np.column_stack([np.cos(angles), np.sin(angles)]))
    return np.concatenate(ends)


def _obstacle(axes: Axes, seen: list[int], obstacle: Obstacle, label: str | None) -> None:
    from scipy.spatial import ConvexHull

    if isinstance(obstacle, Box):
        corners = np.array(list(product((-1.0, 1.0), repeat=3))) * obstacle.half
        points = corners @ obstacle.axes + obstacle.centre
    else:
        assert isinstance(obstacle, Solid)
        points = obstacle.surface.vertices
    flat = points[:, seen]
    outline = flat[ConvexHull(flat).vertices]
    axes.fill(*outline.T, color=_OBSTACLE, alpha=0.35, linewidth=0, label=label)
    axes.annotate(obstacle.name, tuple(outline.mean(axis=0)), ha="center", fontsize=8,
                  color="#444444")


def _branch(axes: Axes, seen: list[int], skeleton: Skeleton) -> None:
    from matplotlib.collections import LineCollection

    child = np.flatnonzero(skeleton.parent >= 0)
    ends = np.stack([skeleton.nodes[skeleton.parent[child]], skeleton.nodes[child]], axis=1)
    axes.add_collection(LineCollection(ends[:, :, seen], colors=_BRANCH, linewidths=1.6, zorder=4,
                                       label="branch"))
    axes.update_datalim(skeleton.nodes[:, seen])
    axes.autoscale_view()


def camera_edges(cell: Cell, flange: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return both ends of the edges of what the camera sees, up to a metre away [m], branch frame;
    ``flange``: its frame there, for a camera on it, shape [4, 4]."""
    camera = cell.camera
    assert camera is not None
    frame = matrices(np.array(camera.pose))
    if camera.mount == "flange":
        frame = flange @ frame
    far = min(camera.range_m[1], _SHOWN_VIEW_M)
    corners = np.array([[(x - camera.centre_px[0]) / camera.focal_px[0],
                         (y - camera.centre_px[1]) / camera.focal_px[1], 1.0]
                        for x, y in ((0, 0), (camera.width, 0), (camera.width, camera.height),
                                     (0, camera.height))])
    ends = far * corners @ frame[:3, :3].T + frame[:3, 3]
    return [*((frame[:3, 3], end) for end in ends), *pairwise([*ends, ends[0]])]


def _camera(axes: Axes, seen: list[int], cell: Cell, flange: np.ndarray) -> None:
    for number, line in enumerate(camera_edges(cell, flange)):
        axes.plot(*np.array(line)[:, seen].T, color=_CAMERA, linewidth=0.9,
                  label="camera's view" if number == 0 else None)


def _frame(axes: Axes, seen: list[int], frame: np.ndarray, name: str, side: str) -> None:
    """The three axes of a frame: x red, y green, z blue."""
    origin = frame[:3, 3]
    for column, colour in zip(frame[:3, :3].T, ("#d62728", "#2ca02c", "#1f77b4"), strict=True):
        axes.plot(*np.array([origin, origin + _AXIS_M * column])[:, seen].T, color=colour,
                  linewidth=1.5, zorder=6)
    axes.annotate(name, tuple(origin[seen]), (4 if side == "left" else -4, -12), fontsize=9,
                  textcoords="offset points", ha=side, zorder=6)
