"""The content of a branch's 3D view, as arrays."""
