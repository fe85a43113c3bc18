"""Objective and optimisers."""
