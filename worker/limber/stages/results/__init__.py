"""Stages that write the report, the scene and exports."""
