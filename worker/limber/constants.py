"""Physical constants, each once."""

STANDARD_GRAVITY = 9.80665
"""Standard acceleration of free fall [m/s^2]."""
GRAVITY = (0.0, 0.0, -STANDARD_GRAVITY)
"""Gravity [m/s^2] in a frame whose z is up: that of a branch of which nothing else is known."""
