"""After the warm-up no user waits for a compiler."""

import subprocess
import sys

import pytest

SCRIPT = """
import sys
import numpy as np
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import *
from limber.mechanics.strain import strain_state
from limber.mechanics.warm_up import warm_up

def compiled():
    modules = [m for n, m in sorted(sys.modules.items()) if n.startswith("limber.mechanics")]
    kernels = {v for m in modules for v in vars(m).values() if hasattr(v, "nopython_signatures")}
    return {k.py_func.__qualname__: len(k.signatures) for k in kernels}

warm_up()
before = compiled()
quadratic = straight_beam(0.2, 0.004, slice_count=4)
for material in ("st_venant_kirchhoff", "stable_neo_hookean", "linear"):
    for mesh in (quadratic, quadratic.linear()):
        model = BranchModel(mesh, young=5e7, poisson=0.35, density=900, material=material)
        for mode in ("point", "rigid"):
            grasp = Grasp.of_nodes(mesh, np.flatnonzero(mesh.nodes[:, 2] > 0.199), mode)
            pose = grasp.rest_pose + np.array([0.002, 0, -0.0001, 0, 0, 0])
            found = solve_static(model, grasp=grasp, pose=pose).require()
            static_sensitivities(model, found, grasp, None, ("log_young", "poisson"))
            simulate_dynamics(model, grasp=grasp, poses=np.array([grasp.rest_pose, pose]),
                              times=np.array([0, 0.02]), sensitivities=ParameterSet())
        found.displacement.flags.writeable = False
        strain_state(model, found.displacement)
        model.largest_principal_strains(found.displacement)
        model.tangent_times(found.displacement, found.displacement)
        solve_static(model, grasp=grasp, pose=pose, start=found)
after = compiled()
assert len(before) > 20, before
print([name for name in after if after[name] != before.get(name)])
"""


@pytest.mark.slow
def test_nothing_is_compiled_after_the_warm_up():
    """Statics, motion and derivatives, all materials and elements, read-only arrays too: the
    kernels have no more signatures than the warm-up gave them."""
    found = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True,
                           timeout=300, check=False)
    assert found.returncode == 0, found.stderr
    assert found.stdout.strip() == "[]"
