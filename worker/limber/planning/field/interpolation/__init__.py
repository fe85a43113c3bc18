"""Interpolation of samples over grasp positions: coordinates, radial functions, trust, errors."""
