"""A picture of each case of the bench `scans`: truth, scan, found axes and their states."""

from pathlib import Path

import numpy as np

from benchmarks.scan_cases import ScanCase
from benchmarks.scan_scores import seen_part
from limber.geometry.skeleton.skeleton import Skeleton

_COLOURS = {0: "tab:red", 1: "tab:orange", 2: "tab:purple", 3: "tab:brown", 4: "magenta"}
_STATES = ("measured", "limited", "interpolated", "unresolved", "bridged")


def draw_case(path: Path, case: ScanCase, found: Skeleton, scored: dict[str, float]) -> None:
    """Write a PNG: the truth in green, the found axes coloured by state, from two sides."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.collections import LineCollection

    middle = case.points.mean(axis=0)
    sides = np.linalg.svd(case.points - middle, full_matrices=False)[2]
    figure, axes = plt.subplots(1, 2, figsize=(14, 10), constrained_layout=True)
    for axis, chosen in zip(axes, ((1, 0), (2, 0)), strict=True):
        def flat(points: np.ndarray, chosen: tuple[int, int] = chosen) -> np.ndarray:
            return ((points - middle) @ sides.T)[:, list(chosen)]

        axis.plot(*flat(case.points[::max(len(case.points) // 20_000, 1)]).T, ".", c="0.8", ms=1.5)
        truth = seen_part(case.truth, case.points)
        for skeleton, colours, width in ((truth, ["tab:green"], 4.0), (
                found, [_COLOURS[int(s)] for s in found.radius_state[1:]], 1.4)):
            nodes = flat(skeleton.nodes)
            axis.add_collection(LineCollection(
                np.stack([nodes[skeleton.parent[1:]], nodes[1:]], axis=1), colors=colours,
                linewidths=width, alpha=0.6 if skeleton is truth else 1.0))
        axis.plot(*flat(truth.nodes[truth.forks()]).T, "go", mfc="none", ms=11)
        axis.plot(*flat(found.nodes[found.forks()]).T, "k^", ms=5)
        axis.plot(*flat(found.nodes[:1]).T, "bs", ms=7)
        axis.set_aspect("equal")
    for state, colour in _COLOURS.items():
        axes[0].plot([], [], c=colour, label=_STATES[state])
    axes[0].legend(fontsize=8)
    figure.suptitle(
        f"{case.name}: centre {scored['centre_radii']:.2f} r, radius {scored['radius_bias']:+.1%}, "
        f"volume {scored['volume']:+.1%},\nforks {scored['forks_found']}/{scored['forks']} + "
        f"{scored['forks_false']} false, main axis {scored['main_axis_radii']:.1f} r", fontsize=10)
    figure.savefig(path, dpi=60)
    plt.close(figure)
