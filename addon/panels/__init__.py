"""The sidebar tab "Limber", and the guide's pages."""
