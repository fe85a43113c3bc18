"""A process is ready soon: what is heavy is imported where it is used."""

import subprocess
import sys

import pytest

HEAVY = ("scipy.stats", "scipy.optimize", "scipy.interpolate", "scipy.ndimage", "matplotlib",
         "distributed", "trimesh", "bpy")
"""Half a second and more of imports that many runs never need."""


@pytest.mark.slow
def test_what_is_heavy_waits_for_its_first_use():
    """``scipy.optimize.minimize(...)`` imports scipy's part when it is called, and not before."""
    code = ("import sys, limber.estimation.fit, limber.planning.make_plan, "
            f"limber.geometry.reconstruction; print([*{set(HEAVY)} & set(sys.modules)])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
