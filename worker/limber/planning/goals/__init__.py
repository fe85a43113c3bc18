"""Goal regions of a path."""
