"""The only interface between numpy arrays and Blender's data. Lengths are in metres."""
