"""Polylines as curve objects."""

import bpy
import numpy as np


def new_polyline(name: str, points: np.ndarray, radius: float) -> bpy.types.Curve:
    """Make a curve through ``points`` [m], shape [p, 3], drawn as a tube of ``radius`` [m]."""
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ValueError(f"{name}: points of shape {points.shape} make no curve")
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions = "3D"
    curve.bevel_depth = radius
    curve.bevel_resolution = 4
    curve.use_fill_caps = True
    spline = curve.splines.new("POLY")
    spline.points.add(len(points) - 1)
    spline.points.foreach_set("co", np.column_stack([points, np.ones(len(points))]).ravel())
    return curve


def polyline_points(curve: bpy.types.Curve) -> np.ndarray:
    """Return the points of the first spline, shape [p, 3]."""
    points = curve.splines[0].points
    values = np.empty(4 * len(points), np.float32)
    points.foreach_get("co", values)
    return values.reshape(-1, 4)[:, :3]
