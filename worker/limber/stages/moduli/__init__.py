"""Stages that estimate Young's modulus and use it."""
