"""Repairs of a skeleton: false connections, backward starts, kinks."""
