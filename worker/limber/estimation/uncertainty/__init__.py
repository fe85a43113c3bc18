"""How far an estimate can be believed: unknowns beside the moduli, intervals, causes."""
