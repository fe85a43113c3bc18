"""The commands of `limber robot`, one per module."""
