"""The report's own figures: scan and skeleton, radii, mesh, pull and energy samples."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.constants import MARK_COLOURS
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.results.findings import modulus_origin
from limber.results.report.charts import chart, draw_faces, two_views
from limber.results.report.estimate_figures import AXIS_DOTS, AXIS_LINES, OBSERVED, SIMULATED
from limber.store import Branch
from limber.store.loading import load_skeleton

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from limber.mechanics.loads.loaded_branch import NamedTarget

ORDER_COLOURS = ("#1f6f43", "#8a6d1d", "#6a4c93", "#7fb685", "#5d6a63")
_CLOUD = "#a9b3ad"
# Most points that are drawn; more only darken the picture and slow it.
_SHOWN_POINTS = 30_000


def scan_and_skeleton(branch: Branch, targets: "Sequence[NamedTarget]") -> "Figure":
    """Cloud, centreline tree, control points and targets, from the front and from the side."""
    skeleton = load_skeleton(branch)
    points = _cloud_points(branch)
    mesh = TetMesh.read(branch.path("mesh.vtu")) if branch.has("mesh.vtu") else None
    figure, views = two_views(points)
    for axis, first, _depth in views:
        axis.scatter(points[:, first], points[:, 2], s=1.0, color=_CLOUD, linewidths=0)
        _draw_tree(axis, skeleton, first)
        if mesh is not None and "control_point" in mesh.point_data:
            nodes = mesh.nodes[mesh.point_data["control_point"] >= 0]
            axis.scatter(nodes[:, first], nodes[:, 2], s=60, facecolors="none",
                         edgecolors=MARK_COLOURS["control_points"], linewidths=1.4, zorder=5)
        for target in targets:
            position = target.position
            axis.plot(position[first], position[2], marker="*", markersize=13,
                      color=MARK_COLOURS["targets"], markeredgecolor="#5c4300", zorder=6)
            axis.annotate(target.name, (position[first], position[2]), (7, 5), fontsize=9,
                          textcoords="offset points", zorder=6)
    return figure


def diameters(skeleton: Skeleton, compared: Sequence[Mapping[str, Any]]) -> "Figure":
    """Diameter along the main path with its interval, and caliper measurements."""
    from limber.geometry.skeleton.qsm_tables import diameters as along_path

    figure, axis = chart(9, 3.2, "distance from the root along the main path [m]",
                         "diameter [mm]", has_grid=True)
    path = skeleton.main_path()
    along = skeleton.arc_length[path]
    thick, sigma = 1e3 * along_path(skeleton, along).T
    colour = _order_colour(0)
    axis.plot(along, thick, color=colour, linewidth=1.4, label="scan")
    axis.fill_between(along, thick - 2 * sigma, thick + 2 * sigma, color=colour, alpha=0.15,
                      linewidth=0)
    if compared:
        axis.plot([row["along_m"] for row in compared],
                  [1e3 * row["measured_m"] for row in compared], "o", color=OBSERVED,
                  markersize=6, label="calipers")
        axis.legend(frameon=False)
    axis.set_ylim(bottom=0)
    return figure


def radii(branch: Branch) -> "Figure":
    """Radius and its uncertainty over the distance from the root, one colour per order."""
    skeleton = load_skeleton(branch)
    figure, axis = chart(9, 3.6, "distance from the root along the tree [m]", "radius [mm]",
                         has_grid=True)
    distance = skeleton.arc_length
    for run in skeleton.runs():
        own = run if skeleton.branch[run[0]] == skeleton.branch[run[-1]] else run[1:]
        colour = _order_colour(int(skeleton.order[own[-1]]))
        axis.plot(distance[own], 1e3 * skeleton.radius[own], color=colour, linewidth=1.2)
        sigma = skeleton.radius_sigma[own]
        if sigma.any():
            axis.fill_between(distance[own], 1e3 * (skeleton.radius[own] - 2 * sigma),
                              1e3 * (skeleton.radius[own] + 2 * sigma), color=colour, alpha=0.15,
                              linewidth=0)
    axis.set_ylim(bottom=0)
    return figure


def mesh_by_modulus(branch: Branch) -> "Figure":
    """The mesh's surface, shaded, coloured by Young's modulus; base and grasp patch marked."""
    import matplotlib.pyplot as plt
    from matplotlib.colors import LogNorm, Normalize

    mesh = TetMesh.read(branch.path("mesh.vtu"))
    faces, young = _coloured_faces(mesh)
    spread = young.max() / young.min()
    low, high = (young.min(), young.max()) if spread > 1.001 else (0.0, 1.5 * young.max())
    norm = (LogNorm if spread > 10 else Normalize)(low / 1e6, high / 1e6)
    figure, views = two_views(mesh.nodes)
    corners = mesh.nodes[faces]
    for axis, first, depth in views:
        colours = plt.get_cmap("viridis")(norm(young / 1e6))
        colours[:, :3] *= _shade(corners, depth)[:, None]
        draw_faces(axis, corners, colours, first, depth)
        for name, colour in (("fixed", MARK_COLOURS["base"]), ("grasp", MARK_COLOURS["grasp"])):
            marked = mesh.nodes[np.asarray(mesh.point_data.get(name, [])).nonzero()[0]]
            axis.scatter(marked[:, first], marked[:, 2], s=3, color=colour, zorder=4)
    title = f"Young's modulus ({modulus_origin(branch)})"
    if spread > 1.001:
        scale = plt.cm.ScalarMappable(norm, "viridis")
        figure.colorbar(scale, ax=figure.axes, label=f"{title} [MPa]", shrink=0.7)
    else:
        figure.suptitle(f"{title} {young.mean() / 1e6:.4g} MPa everywhere", fontsize=10)
    return figure


def pull(recording: Any) -> "Figure":
    """Force on the branch and displacement of the grasp over time."""
    import matplotlib.pyplot as plt

    time = recording.times
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(9, 5), sharex=True, layout="constrained")
    moved = recording.poses[:, :3] - recording.poses[0, :3]
    for column, (name, line) in enumerate(AXIS_LINES.items()):
        style = {"color": OBSERVED, "ls": line, "marker": AXIS_DOTS[name], "ms": 3, "label": name}
        upper.plot(time, recording.wrenches[:, column], **style)
        lower.plot(time, 1e3 * moved[:, column], **style)
    upper.set(ylabel="force on the branch [N]")
    lower.set(ylabel="displacement of the grasp [mm]", xlabel="time [s]")
    for axis in (upper, lower):
        axis.grid(alpha=0.25)
    upper.legend(ncols=3, frameon=False, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def motion(time: np.ndarray, energies: np.ndarray, kinetic: np.ndarray, force: np.ndarray,
           ) -> "Figure":
    """Energies [J] and grasp force [N] [n, 3] of a simulated motion over time [s]."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.8), layout="constrained")
    left.plot(time, 1e3 * energies, color=SIMULATED, label="strain")
    if kinetic.any():
        left.plot(time, 1e3 * kinetic, "--", color=SIMULATED, label="kinetic")
    left.set(xlabel="time [s]", ylabel="energy [mJ]")
    for (name, line), column in zip(AXIS_LINES.items(), force.T, strict=True):
        right.plot(time, column, line, color=SIMULATED, label=name)
    right.set(xlabel="time [s]", ylabel="force on the grasp [N]")
    for axis in (left, right):
        axis.grid(alpha=0.25)
        axis.legend(ncols=3, frameon=False, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def energy_samples(positions: np.ndarray, energies: np.ndarray, forces: np.ndarray) -> "Figure":
    """Energy [J] and force [N] of the sampled grasps over their distance from rest, the first."""
    import matplotlib.pyplot as plt

    distance = 1e3 * np.linalg.norm(positions - positions[0], axis=1)
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.8))
    left.scatter(distance, 1e3 * energies, s=9, color=SIMULATED)
    left.set(xlabel="displacement of the grasp [mm]", ylabel="strain energy [mJ]")
    force = np.linalg.norm(forces, axis=1)
    right.scatter(distance, force, s=9, color=SIMULATED)
    right.set(xlabel="displacement of the grasp [mm]", ylabel="force [N]")
    for axis in (left, right):
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.25)
    return figure


def _draw_tree(axis: Any, skeleton: Skeleton, first: int) -> None:
    from matplotlib.collections import LineCollection

    child = np.flatnonzero(skeleton.parent >= 0)
    ends = np.stack([skeleton.nodes[skeleton.parent[child]], skeleton.nodes[child]], axis=1)
    colours = [_order_colour(int(order)) for order in skeleton.order[child]]
    axis.add_collection(LineCollection(ends[:, :, [first, 2]], colors=colours, linewidths=1.3,
                                       zorder=3))


def _order_colour(order: int) -> str:
    return ORDER_COLOURS[min(order, len(ORDER_COLOURS) - 1)]


def _cloud_points(branch: Branch) -> np.ndarray:
    from limber.geometry.io.clouds import read_cloud

    points = read_cloud(branch.path("cloud.ply")).points
    return points[:: max(1, len(points) // _SHOWN_POINTS)]


def _coloured_faces(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Boundary faces and the modulus of the tetrahedra behind them, from nodal averages."""
    faces = mesh.surface_faces()
    corners = mesh.tets[:, :4]
    total = np.zeros(mesh.node_count)
    count = np.zeros(mesh.node_count)
    np.add.at(total, corners, mesh.cell_data["young"][:, None])
    np.add.at(count, corners, 1.0)
    nodal = total / np.maximum(count, 1.0)
    return faces, nodal[faces].mean(axis=1)


def _shade(corners: np.ndarray, depth: int) -> np.ndarray:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    facing = np.abs(normal[:, depth]) / np.where(length > 0, length, 1.0)
    return 0.45 + 0.55 * facing
