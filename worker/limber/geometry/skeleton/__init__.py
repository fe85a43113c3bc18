"""Centreline trees: from a cloud by contraction, with radii, repaired and judged."""
