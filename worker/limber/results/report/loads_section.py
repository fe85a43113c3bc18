"""Figures of wind, snow, fruit and cuts that act on a branch."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from limber.core.files.reading import read_arrays, require_shapes
from limber.geometry.tets.tet_mesh import TetMesh
from limber.results.motion_files import read_pc2
from limber.results.report.charts import draw_faces, two_views

if TYPE_CHECKING:
    from matplotlib.figure import Figure

def bent_branch(mesh: TetMesh, frames: Path) -> "Figure":
    """Draw the branch as scanned (grey) and under the loads of ``frames/load-NAME.pc2``, coloured
    by its largest strain in the ``.npz`` beside it; InputError if they are damaged or belong to
    another mesh."""
    import matplotlib.pyplot as plt

    nodes, corners = np.unique(mesh.surface_faces(), return_inverse=True)
    corners = corners.reshape(-1, 3)
    positions, _, _ = read_pc2(frames)
    values = read_arrays(frames.with_suffix(".npz"), "the fields of a motion")
    arrays = {**values, "positions": positions}
    require_shapes(frames, arrays, {"positions": (2, len(nodes), 3),
                                    "principal_strain": (2, len(nodes))}, "the frames of a load")
    strain = 100 * arrays["principal_strain"][1][corners].mean(axis=1)
    shades = plt.get_cmap("inferno")
    largest = max(float(strain.max()), 1e-9)
    norm = plt.Normalize(0.0, largest)
    figure, views = two_views(positions.reshape(-1, 3))
    grey = np.tile((0.8, 0.8, 0.8, 1.0), (len(corners), 1))
    for axis, across, depth in views:
        for state, colours in zip(positions, (grey, shades(0.9 * norm(strain))), strict=True):
            draw_faces(axis, state[corners], colours, across, depth)
    scale = plt.cm.ScalarMappable(plt.Normalize(0.0, largest / 0.9), shades)
    bar = figure.colorbar(scale, ax=figure.axes, label="largest principal strain [%]", shrink=0.7)
    bar.ax.set_ylim(0.0, largest)
    return figure


def strain_along_path(along: np.ndarray) -> "Figure":
    """Draw the largest strain of each piece of the main path: its ends from the root [m] and the
    largest principal strain, [n, 3]."""
    from matplotlib.figure import Figure

    from_m, to_m, strain = along.T
    figure = Figure(figsize=(6.0, 3.2), layout="constrained")
    axes = figure.add_subplot()
    axes.bar(from_m, 100 * strain, to_m - from_m, align="edge", edgecolor="white")
    axes.set(xlabel="distance from the root along the main path [m]", ylabel="largest strain [%]")
    axes.spines[["top", "right"]].set_visible(False)
    return figure
