"""A planned path as motion of a robot: joints, times, expected wrenches, retreat."""
