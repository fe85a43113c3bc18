"""Physical constants, what units are in SI, and names that several rooms share, each once."""

STANDARD_GRAVITY = 9.80665
"""Standard acceleration of free fall [m/s^2]."""
GRAVITY = (0.0, 0.0, -STANDARD_GRAVITY)
"""Gravity [m/s^2] in a frame whose z is up: that of a branch of which nothing else is known."""
FORCE_UNITS_N = {"N": 1.0, "gf": 1e-3 * STANDARD_GRAVITY, "mN": 1e-3,
                 "lbf": 0.45359237 * STANDARD_GRAVITY, "kgf": STANDARD_GRAVITY, "kN": 1e3}
"""Newtons in one of the units that force sensors report."""
UNIT_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "um": 1e-6}
"""Metres in one of the units that scans, surfaces and skeletons come in."""

FOUND_SKELETON = "scan_skeleton"
"""The skeleton as a scan showed it, in the coordinates of the scan's file: .swc and .csv."""

PATH_COLOURS = {"plan": "#e52145", "baseline": "#1965ce"}
"""Of the planned path and of the one that it is compared with, in report and scene; the add-on's
``COLORS`` are the same, linear."""
DATA_COLOURS = {"measured": "#00a5bd", "simulated": "#222222", "true": "#c0602a"}
"""Of what was measured, what the model says, and what is known or assumed to be so."""
MARK_COLOURS = {"grasp": "#f98900", "control_points": "#ce27c4", "targets": "#e1b300",
                "base": "#594e45"}
"""Of marks on the branch, in report and scene alike."""
