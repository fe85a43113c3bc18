"""The whole loop against a virtual robot that holds a branch, run by `limber demo --robot`."""
