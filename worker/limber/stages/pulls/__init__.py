"""Stages that record, import, simulate and suggest pulls."""
