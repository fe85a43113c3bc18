"""Machines beyond this process: clusters and staging of files."""
