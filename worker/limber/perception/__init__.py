"""From what a camera saw to control points over time."""
