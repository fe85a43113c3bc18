"""Stages that plan a path and follow it with a robot."""
