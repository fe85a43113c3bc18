"""Physical constants, units in SI, and names that several packages share."""

STANDARD_GRAVITY = 9.80665
"""Standard gravity [m/s^2]."""
GRAVITY = (0.0, 0.0, -STANDARD_GRAVITY)
"""Gravity [m/s^2] in a frame with z up; used for a branch if nothing else is known."""
FORCE_UNITS_N = {"N": 1.0, "gf": 1e-3 * STANDARD_GRAVITY, "mN": 1e-3,
                 "lbf": 0.45359237 * STANDARD_GRAVITY, "kgf": STANDARD_GRAVITY, "kN": 1e3}
"""Units of force that force sensors report, in newtons."""
UNIT_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "um": 1e-6}
"""Units of length of scans, surfaces and skeletons, in metres."""

FOUND_SKELETON = "scan_skeleton"
"""The skeleton as found in a scan, in the coordinates of the scan's file: .swc and .csv."""

PATH_COLOURS = {"plan": "#e52145", "baseline": "#1965ce"}
"""Colours of the planned path and of its baseline, in report and scene; the add-on's ``COLORS`` are
the same in linear form.
"""
DATA_COLOURS = {"measured": "#00a5bd", "simulated": "#222222", "true": "#c0602a"}
"""Colours of measured, modelled, and known or assumed values."""
MARK_COLOURS = {"grasp": "#f98900", "control_points": "#ce27c4", "targets": "#e1b300",
                "base": "#594e45"}
"""Colours of marks on the branch, in report and scene."""
