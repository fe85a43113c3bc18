"""Where a path may end."""
