"""Clouds of laser scanners and of photogrammetry: E57, PTX, COLMAP's binary points."""
