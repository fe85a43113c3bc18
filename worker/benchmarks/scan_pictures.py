"""A picture of a scan and its skeleton: cloud, true axes, found axes and their states."""

from pathlib import Path

import numpy as np

from limber.geometry.skeleton.skeleton import Skeleton

_COLOURS = {0: "tab:red", 1: "tab:orange", 2: "tab:purple", 3: "tab:brown", 4: "magenta"}
_STATES = ("measured", "limited", "interpolated", "unresolved", "bridged")


def draw(path: Path, points: np.ndarray, found: Skeleton, title: str,
         truth: Skeleton | None = None) -> None:
    """Write a PNG: the truth in green, the found axes coloured by state, from two sides."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.collections import LineCollection

    middle = points.mean(axis=0)
    sides = np.linalg.svd(points[::max(len(points) // 20_000, 1)] - middle, full_matrices=False)[2]
    figure, axes = plt.subplots(1, 2, figsize=(14, 10), constrained_layout=True)
    for axis, chosen in zip(axes, ([1, 0], [2, 0]), strict=True):
        def flat(places: np.ndarray, chosen: list[int] = chosen) -> np.ndarray:
            return ((places - middle) @ sides.T)[:, chosen]

        axis.plot(*flat(points[::max(len(points) // 20_000, 1)]).T, ".", c="0.8", ms=1.5)
        for skeleton in filter(None, (truth, found)):
            nodes, is_found = flat(skeleton.nodes), skeleton is found
            axis.add_collection(LineCollection(
                np.stack([nodes[skeleton.parent[1:]], nodes[1:]], axis=1),
                colors=[_COLOURS[int(state)] for state in found.radius_state[1:]] if is_found
                else ["tab:green"], linewidths=1.4 if is_found else 4.0,
                alpha=1.0 if is_found else 0.6))
            axis.plot(*nodes[skeleton.forks()].T, *(["k^"] if is_found else ["go"]),
                      mfc="k" if is_found else "none", ms=5 if is_found else 11)
        axis.plot(*flat(found.nodes[:1]).T, "bs", ms=7)
        axis.set_aspect("equal")
    for state, colour in _COLOURS.items():
        axes[0].plot([], [], c=colour, label=_STATES[state])
    axes[0].legend(fontsize=8)
    figure.suptitle(title, fontsize=10)
    figure.savefig(path, dpi=60)
    plt.close(figure)
