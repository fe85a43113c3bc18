"""Stages that make a branch: scan or surface to skeleton and tetrahedra."""
