"""The one door between numpy arrays and Blender's data. Lengths in metres, one unit one metre."""
