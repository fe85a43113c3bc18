"""A robot's cell: arms, the cell file, obstacles, reach and collision; no driver, no sockets."""
