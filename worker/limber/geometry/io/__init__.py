"""Readers and writers of point clouds, skeletons and surfaces, in the formats of other programs."""
