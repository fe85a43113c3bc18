"""A branch of the scene and its folder: which is the current one, what it consists of."""
