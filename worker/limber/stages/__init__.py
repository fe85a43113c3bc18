"""The stages: one file each, found by :mod:`limber.stages.registry`."""
