"""The picture of where a planned path would damage the branch."""

from typing import TYPE_CHECKING

import numpy as np

from limber.planning.constraints.damage import DamageAlong
from limber.results.report.charts import two_views

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LEAST = 1e-4  # probabilities below look alike


def damage_along_branch(damage: DamageAlong) -> "Figure":
    """Draw the branch's axes from the front and the side, coloured by the probability of damage, or
    by the largest strain if the strength is not known. The worst place is marked."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LogNorm, Normalize

    values, label = 100.0 * damage.strains, "largest strain along the path [%]"
    norm: Normalize = Normalize(0.0, max(float(values.max()), 1e-9))
    if damage.probabilities is not None:
        values, label = 100.0 * damage.probabilities, "probability of damage here [%]"
        norm = LogNorm(100.0 * _LEAST, 100.0, clip=True)
    child = np.flatnonzero(damage.parents >= 0)
    ends = damage.nodes[np.stack([damage.parents[child], child], axis=1)]
    figure, views = two_views(damage.nodes)
    worst = damage.nodes[int(np.argmax(damage.strains))]
    for axis, across, _ in views:
        lines = LineCollection(ends[:, :, [across, 2]], cmap="inferno_r", norm=norm, linewidths=4.0,
                               capstyle="round")
        lines.set_array(values[child])
        axis.add_collection(lines)
        axis.plot(worst[across], worst[2], "o", mfc="none", mec="black", ms=14)
        axis.autoscale_view()
    figure.colorbar(lines, ax=[axis for axis, _, _ in views], label=label)
    return figure
