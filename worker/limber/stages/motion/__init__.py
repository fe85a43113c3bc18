"""Stages that bend a branch: pulls, forces and loads."""
