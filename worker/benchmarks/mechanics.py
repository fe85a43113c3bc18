"""Mechanics: exact solutions, convergence, the clock, the reduced model, other programs."""

from benchmarks import mechanics_exact as exact
from benchmarks import mechanics_peers as peers
from benchmarks import mechanics_reduced as reduced
from benchmarks import mechanics_speed as speed
from benchmarks.table import Part

PARTS = {
    "exactness": Part(exact.exactness_rows, 25, exact.EXACTNESS),
    "elastica": Part(exact.elastica_rows, 10, exact.ELASTICA_ROWS),
    "element-rate": Part(exact.element_rate_row, 20, (exact.ELEMENT_RATE,)),
    "time-rate": Part(exact.time_rate_row, 5, (exact.TIME_RATE,)),
    "vibration": Part(exact.vibration_row, 5, (exact.VIBRATION,)),
    "rest-shape": Part(exact.rest_shape_row, 5, (exact.REST_SHAPE,)),
    "reduced": Part(reduced.pinned_rows, 180, reduced.PINNED_ROWS),
    "steps": Part(speed.speed_rows, 15, speed.SPEED_ROWS),
    "grasps": Part(speed.grasp_row, 120, (speed.GRASPS,)),
    "linear": Part(speed.linear_row, 5, (speed.LINEAR,)),
    "memory": Part(speed.memory_row, 20, (speed.MEMORY,)),
    "clamped": Part(reduced.clamped_rows, 90, (reduced.CLAMPED_ROW,)),
    "felupe": Part(peers.felupe_row, 60, (peers.FELUPE,)),
    "scikit-fem": Part(peers.skfem_row, 15, (peers.SKFEM,))}
"""The table, in order of importance."""
