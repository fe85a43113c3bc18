"""Polylines as tubes."""

import bpy
import numpy as np


def new_tube(name: str, points: np.ndarray, radius: float) -> bpy.types.Mesh:
    """Make a tube of ``radius`` [m] along ``points`` [m], shape [p, 3]: a mesh with colours."""
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ValueError(f"{name}: points of shape {points.shape} do not form a curve")
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions = "3D"
    curve.bevel_depth = radius
    curve.bevel_resolution = 4
    curve.use_fill_caps = True
    spline = curve.splines.new("POLY")
    spline.points.add(len(points) - 1)
    spline.points.foreach_set("co", np.column_stack([points, np.ones(len(points))]).ravel())
    thing = bpy.data.objects.new(name, curve)
    tube = bpy.data.meshes.new_from_object(thing)
    tube.name = name
    bpy.data.objects.remove(thing)
    bpy.data.curves.remove(curve)
    return tube
