"""The paper's last figure: paths of two planners, coloured by the energy at their waypoints."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from limber.planning.compared_planners import BASELINE, COMPARED, ComparedTrial
from limber.planning.field.energy_field import EnergyField

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHOWN = (BASELINE, "D-RRT*, not smoothed", "eikonal")
_SHELL = 600  # poses of the field drawn behind the paths


def planner_figure(field: EnergyField, trials: Sequence[ComparedTrial]) -> "Figure":
    """Draw the paths of each planner in a separate view, over the field's energy."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.0 * len(_SHOWN), 4.2), layout="constrained")
    behind = field.region.draw(_SHELL, np.random.default_rng(0))
    energies = 1e3 * field.energy(behind)
    most = float(np.quantile(energies, 0.95))
    for number, name in enumerate(_SHOWN):
        axes = figure.add_subplot(1, len(_SHOWN), number + 1, projection="3d")
        axes.scatter(*behind.T, c=energies, s=3, alpha=0.12, vmin=0.0, vmax=most, cmap="viridis")
        for trial in trials:
            if (path := trial.paths.get(name)) is None:
                continue
            axes.plot(*path.T, color="black", lw=0.6)
            dots = axes.scatter(*path.T, c=1e3 * field.energy(path), s=12, vmin=0.0, vmax=most,
                                cmap="viridis", depthshade=False)
        axes.set(title=COMPARED[name], xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
        axes.set_aspect("equal")
        axes.locator_params(nbins=4)
    figure.colorbar(dots, ax=figure.axes, label="deformation energy [mJ]", shrink=0.7)
    return figure
