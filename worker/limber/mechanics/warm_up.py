"""Compiles all kernels once, so that no user has to wait for the compiler."""

import numpy as np

from limber.core.progress import SILENT, Progress
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.dynamics.integration import simulate_dynamics
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.model import BranchModel
from limber.mechanics.sensitivities import ParameterSet


def warm_up(progress: Progress = SILENT) -> None:
    """Run statics, motion and derivatives with one tetrahedron and users' types, so that each
    kernel is compiled into the user's cache: a minute at first, under two seconds later."""
    corners = 0.01 * np.vstack([np.zeros(3), np.eye(3)])
    mesh = TetMesh(corners, np.array([[0, 1, 2, 3]])).quadratic()
    for number, damping in enumerate((RayleighDamping(), RayleighDamping(0.0, 0.0))):
        progress(number / 2, "compiling kernels")
        model = BranchModel(mesh, young=1e7, poisson=0.3, density=900.0, damping=damping,
                            fixed=np.array([0, 1, 2]))
        simulate_dynamics(model, times=np.array([0.0, 0.01]), sensitivities=ParameterSet())
    rest = np.zeros_like(mesh.nodes)
    model.largest_principal_strains(rest)
    # Zero forces are not solved for.
    model.equations().tangent(model, rest).solve_all(3 * [rest + 1.0])
    progress(1.0, "compiling kernels")
