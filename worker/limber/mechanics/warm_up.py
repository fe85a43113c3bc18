"""Compiling the kernels ahead of time, so that no user waits for a compiler."""

import time

import numpy as np

from limber.mechanics.dynamics import simulate_dynamics
from limber.mechanics.grasp import Grasp
from limber.mechanics.materials import RayleighDamping
from limber.mechanics.model import BranchModel
from limber.mechanics.statics import solve_static
from limber.progress import SILENT, Progress

_MATERIALS = ("st_venant_kirchhoff", "stable_neo_hookean", "linear")


def warm_up(progress: Progress = SILENT) -> dict[str, float]:
    """Run every kernel once on a small beam; numba keeps what it compiles in the user's cache.

    Returns:
        ``seconds`` that it took: tens the first time, about one afterwards.
    """
    from limber.geometry.cylinder_mesh import straight_beam

    started = time.perf_counter()
    quadratic = straight_beam(0.2, 0.01, slice_count=3)
    meshes = (quadratic, quadratic.linear())
    for number, (mesh, material) in enumerate((m, n) for m in meshes for n in _MATERIALS):
        progress(number / 6, "compiling", material=material)
        model = BranchModel(mesh, young=1e7, poisson=0.3, density=900.0, material=material,
                            damping=RayleighDamping(0.5, 0.002))
        grasp = Grasp.from_mesh(mesh, "pinned")
        pose = grasp.rest_pose + np.array([1e-3, 0, 0, 0, 0, 0])
        solve_static(model, grasp=grasp, pose=pose)
        simulate_dynamics(model, times=np.array([0.0, 0.02]))
    progress(1.0, "compiled")
    return {"seconds": round(time.perf_counter() - started, 2)}
