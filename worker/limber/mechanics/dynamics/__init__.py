"""Motion in time: implicit Newmark steps, loads, derivatives along the motion."""
