"""The sidebar tab "Limber": one file per step of the work."""
