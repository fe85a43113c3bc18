"""Plan a path: the goal, its energy field, and the motion along the path."""
