"""Tetrahedral meshes of a branch: swept along its axes or by fTetWild."""
