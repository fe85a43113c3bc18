"""Compiles all kernels once, so that no user waits for a compiler."""

import numpy as np

from limber.geometry.tet_mesh import TetMesh
from limber.mechanics.equations import Viscous
from limber.mechanics.model import BranchModel
from limber.mechanics.reduced_strain import compile_kernels
from limber.progress import SILENT, Progress


def warm_up(progress: Progress = SILENT) -> None:
    """Call every kernel on one tetrahedron; the compiled code stays in the user's cache folder.

    About 30 s where nothing is compiled yet, under a second afterwards.
    """
    corners = np.vstack([np.zeros(3), np.eye(3)])
    mesh = TetMesh(corners, np.array([[0, 1, 2, 3]])).quadratic()
    moved = np.zeros_like(mesh.nodes)
    calls = 0
    for material in ("st_venant_kirchhoff", "stable_neo_hookean"):
        model = BranchModel(mesh, young=1.0, poisson=0.3, density=1.0, material=material,
                            fixed=np.array([0, 1, 2]))
        strain = model.strains(moved)
        viscous = Viscous(1.5, strain)
        equations = model.equations()
        for work in (lambda m=model: m.internal(moved),
                     lambda m=model: m.tangent_times(moved, moved),
                     lambda m=model: m.strain_changes(moved, moved),
                     lambda m=model, e=equations, v=viscous: e.assemble(m, moved, viscous=v)):
            progress(calls / 8, "compiling kernels")
            work()
            calls += 1
    compile_kernels()
    progress(1.0, "compiling kernels")
