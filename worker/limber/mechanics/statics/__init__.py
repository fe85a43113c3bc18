"""Static equilibrium: path following, snaps, the unloaded rest shape."""
