"""The whole loop against a virtual robot that holds a branch: what `limber demo --robot` runs."""
