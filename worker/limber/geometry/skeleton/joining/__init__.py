"""Pieces of a scan joined to one tree over its gaps."""
