"""Joining of a scan's pieces to one tree over its gaps."""
