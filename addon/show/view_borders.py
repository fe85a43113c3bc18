"""Drawings over the 3D view: marks, scans, legend and graph."""

import bpy


def covered_width(context: bpy.types.Context, kind: str) -> float:
    """Return how many pixels of the view its toolbar ("TOOLS") or sidebar ("UI") covers."""
    region = next((region for region in context.area.regions if region.type == kind), None)
    return 0.0 if region is None or region.width <= 1 else float(region.width)
