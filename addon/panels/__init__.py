"""The sidebar tab "Limber": one step of the work a file."""
