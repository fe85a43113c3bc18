"""Clouds of Gaussian splats, as radiance fields are trained and as viewers pack them.

Centres lie on surfaces where a splat is opaque; transparent and wide ones hang in the air. Layouts:
graphdeco-inria/gaussian-splatting (``save_ply``: opacities before the sigmoid, scales before the
exponential, colours as spherical harmonics), playcanvas/supersplat (compressed PLY).
"""

from typing import Any

import numpy as np
from scipy.special import expit

from limber.core.errors import InputError, Option, Text
from limber.geometry.cloud.cloud import Cloud

_OPAQUE = 0.5
"""Least opacity of a splat on a surface: more than half of the light ends there."""
_WIDE = 10.0
"""A splat whose middle axis is longer than this many usual ones is haze, or sky."""
_LARGEST = 50.0  # logarithm of a scale
_HARMONIC = 0.28209479177387814
"""Of degree 0: 1 / (2 sqrt(pi))."""
_CHUNK = 256  # splats that share a box in a compressed PLY


def ply_splats(content: Any) -> Cloud | None:
    """Return the opaque splats of a PLY file as plyfile read it; None if it holds no splats."""
    rows = content["vertex"].data
    names = set(rows.dtype.names or ())
    if "packed_position" in names and "chunk" in content:
        return _unpacked(rows, content["chunk"].data)
    if not {"opacity", "scale_0", "scale_1", "rot_0", "x", "y", "z"} <= names:
        return None
    opacity, scale = (_columns(rows, prefix) for prefix in ("opacity", "scale_"))
    # Some programs write what the original applies its functions to only when it draws.
    if not (0 <= opacity.min(initial=0) and opacity.max(initial=0) <= 1 and (scale > 0).all()):
        opacity, scale = expit(opacity), np.exp(np.minimum(scale, _LARGEST))
    color = _columns(rows, "f_dc_")
    return opaque(np.column_stack([rows[axis].astype(float) for axis in "xyz"]), opacity[:, 0],
                  scale, np.clip(0.5 + _HARMONIC * color, 0, 1) * 255 if color.size else None)


def _columns(rows: np.ndarray, prefix: str) -> np.ndarray:
    """All columns that begin so, shape [n, k]."""
    names = [name for name in rows.dtype.names or () if name.startswith(prefix)]
    return np.array([rows[name] for name in names], float).reshape(len(names), len(rows)).T


def _unpacked(rows: np.ndarray, chunks: np.ndarray) -> Cloud:
    """Splats of a compressed PLY: fractions of the box of their chunk, in 11, 10 and 11 bits."""
    chunk = chunks[np.arange(len(rows)) // _CHUNK]

    def between(name: str, title: str) -> np.ndarray:
        bits = rows[name].astype(np.int64)
        part = np.stack([bits >> 21, bits >> 11 & 1023, bits & 2047], axis=1) / [2047, 1023, 2047]
        low, high = (np.stack([chunk[f"{end}_{title}{axis}"] for axis in "xyz"], axis=1)
                     for end in ("min", "max"))
        return low + part * (high - low)

    rgba = rows["packed_color"].astype(">u4").view("u1").reshape(-1, 4)
    return opaque(between("packed_position", ""), rgba[:, 3] / 255,
                  np.exp(np.minimum(between("packed_scale", "scale_"), _LARGEST)), rgba[:, :3])


def opaque(points: np.ndarray, opacity: np.ndarray, scale: np.ndarray, color: np.ndarray | None,
           ) -> Cloud:
    """Return the centres [n, 3] of splats on surfaces, with colour 0..255 [n, 3] and a note about
    the others.

    Args:
        points: Shape [n, 3], in the unit of the file.
        opacity: 0 to 1, shape [n].
        scale: Standard deviations along the axes, shape [n, k], in the unit of the file.
        color: 0 to 255, shape [n, 3], if known.

    Raises:
        InputError: none is opaque.
    """
    clear = ~(opacity >= _OPAQUE)
    width = np.sort(scale, axis=1)[:, -2]
    wide = ~clear & ~(width <= _WIDE * np.median(width[~clear])) if not clear.all() else clear
    kept = ~(clear | wide)
    if not kept.any():
        raise InputError(f"None of {len(points)} Gaussian splats has an opacity of {_OPAQUE:g} or "
                         f"more (the largest: {np.nanmax(opacity, initial=0):.2g}).",
                         "Points on surfaces come from opaque splats.",
                         "Train it longer, or export a point cloud or a mesh.")
    note = Text(f"{len(points)} Gaussian splats: {int(kept.sum())} are opaque and were read as "
                f"points; {int(clear.sum())} more transparent than {_OPAQUE:g} and "
                f"{int(wide.sum())} over {_WIDE:g} times as wide as usual were left out. A "
                "radiance field has the scale and the up direction of its photographs: compare a "
                "length with the plant, and state ", Option("up"), " if it is not z.")
    attributes = {} if color is None else {"color": np.round(color[kept]).astype(np.uint8)}
    return Cloud(np.asarray(points, float)[kept], attributes, notes=(note,))
