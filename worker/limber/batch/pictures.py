"""A picture of each branch for the summary: its axes from two sides, coloured by modulus."""

import html
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import LimberError
from limber.geometry.io.skeletons import read_swc
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.results.scene.colours import colour_scale, css_colours

HEIGHT = 150
"""Size of a picture [pixels]."""
_EDGE = 6
_WOOD = "#5a4632"
_VIEWS = (("from the front", 0), ("from the side", 1))


def pictures(folder: Path) -> str:
    """Return drawings (SVG) of a branch, with the range of its modulus; empty if it has no axes.

    The modulus is that of the mesh; if it is uniform or unknown, wood is brown.
    """
    try:
        skeleton = read_swc(folder / "skeleton.swc")
    except (OSError, LimberError):
        return "<div class=pictures></div>"
    young = _moduli(folder / "mesh.vtu", skeleton)
    colours, caption = [_WOOD] * skeleton.node_count, ""
    if young is not None:
        scale = colour_scale(young, "Young's modulus", "Pa", "viridis")
        colours = css_colours(young, scale)
        caption = (f"<p class=range>Young's modulus {scale['ticks'][0]} (dark) to "
                   f"{scale['ticks'][-1]} (bright)</p>")
    drawn = "".join(_view(skeleton, colours, label, axis) for label, axis in _VIEWS)
    return f"<div class=pictures>{drawn}{caption}</div>"


def _moduli(path: Path, skeleton: Skeleton) -> np.ndarray | None:
    """Young's modulus at each node [Pa]; None if it is unknown or uniform."""
    try:
        mesh = TetMesh.read(path)
    except (OSError, LimberError):
        # No mesh yet, or a damaged one: its own stage reports it.
        return None
    young = mesh.cell_data.get("young")
    if young is None or not (np.isfinite(young) & (young > 0)).all():
        return None
    near = cKDTree(mesh.centroids).query(skeleton.nodes)[1]
    found = np.asarray(young, float)[near]
    return found if found.max() > 1.001 * found.min() else None


def _view(skeleton: Skeleton, colours: list[str], label: str, axis: int) -> str:
    flat = skeleton.nodes[:, [axis, 2]]
    low, size = flat.min(axis=0), np.maximum(np.ptp(flat, axis=0), 1e-9)
    scale = (HEIGHT - 2 * _EDGE) / max(size[1], size[0] / 2)
    pixels = (flat - low) * scale + _EDGE
    width = size[0] * scale + 2 * _EDGE
    pixels[:, 1] = HEIGHT - pixels[:, 1]
    lines = "".join(_lines(skeleton, pixels, colours, scale))
    return (f"<svg class=sketch viewBox='0 0 {width:.0f} {HEIGHT}' width={width:.0f} "
            f"height={HEIGHT} stroke-linecap=round role=img aria-label='{html.escape(label)}'>"
            f"<title>{html.escape(label)}</title>{lines}</svg>")


def _lines(skeleton: Skeleton, pixels: np.ndarray, colours: list[str], scale: float,
           ) -> Iterator[str]:
    thick = np.maximum(2 * skeleton.radius * scale, 0.7)
    for node, up in enumerate(skeleton.parent):
        if up >= 0:
            yield (f"<line x1='{pixels[up, 0]:.1f}' y1='{pixels[up, 1]:.1f}' "
                   f"x2='{pixels[node, 0]:.1f}' y2='{pixels[node, 1]:.1f}' "
                   f"stroke='{colours[node]}' stroke-width='{thick[node]:.1f}'/>")
