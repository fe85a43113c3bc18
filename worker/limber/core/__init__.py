"""The base of every package: errors, progress, settings, files, processes, numerics."""
