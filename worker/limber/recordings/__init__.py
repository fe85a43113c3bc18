"""Recordings of pulls: formats, tables, alignment, registration, checks."""
