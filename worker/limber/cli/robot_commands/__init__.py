"""The commands of `limber robot`, one a module."""
