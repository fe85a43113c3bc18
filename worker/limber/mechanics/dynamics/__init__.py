"""Motion in time: implicit Newmark, what drives it, derivatives along it."""
