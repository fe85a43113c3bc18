"""What a path must keep: limits, obstacles, and their checks on the full model and in motion."""
