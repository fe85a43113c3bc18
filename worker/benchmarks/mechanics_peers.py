"""Other programs on the same cantilever, if their wheels are installed."""

import time
from importlib.util import find_spec

import numpy as np

from benchmarks.mechanics_exact import LENGTH, YOUNG, Cantilever
from benchmarks.table import Asked, Row, Setting

FELUPE = Asked("peer: felupe, same mesh, material and load (alpha 2)", "-")
SKFEM = Asked("peer: scikit-fem, same mesh, linear elasticity (no large deflection as shipped)",
              "-")


def felupe_row(_setting: Setting) -> list[Row]:
    """Measure felupe, or report that it is not installed."""
    return [_felupe_row() if find_spec("felupe") else _absent(FELUPE)]


def skfem_row(_setting: Setting) -> list[Row]:
    """Measure scikit-fem, or report that it is not installed."""
    return [_skfem_row() if find_spec("skfem") else _absent(SKFEM)]


def _absent(asked: Asked) -> Row:
    return Row(*asked, "not installed (pip install felupe scikit-fem)", None, 0)


def _problem() -> tuple:
    beam = Cantilever.make()
    force = 2 * YOUNG * beam.inertia / LENGTH**2
    start = time.process_time()
    from limber.mechanics import solve_static

    result = solve_static(beam.model(), grasp=beam.end, grasp_force=[force, 0, 0]).require()
    seconds = time.process_time() - start
    moved = (beam.end.weights @ result.displacement[beam.end.nodes])[0]
    loads = np.zeros_like(beam.mesh.nodes)
    loads[beam.end.nodes, 0] = force * beam.end.weights
    return beam, loads, moved, seconds


def _felupe_row() -> Row:
    import felupe

    from limber.mechanics.materials.materials import lame

    beam, loads, ours, our_seconds = _problem()
    mesh = felupe.Mesh(beam.mesh.nodes, beam.mesh.tets, "tetra10")
    field = felupe.FieldContainer([felupe.Field(felupe.RegionQuadraticTetra(mesh), dim=3)])
    lam, mu = lame(np.array(YOUNG), np.array(0.35))
    material = felupe.Material(stress=_stvk_stress, elasticity=_stvk_elasticity,
                               lam=float(lam), mu=float(mu))
    solid = felupe.SolidBody(material, field)
    fixed = {"base": felupe.Boundary(field[0], fz=lambda z: np.abs(z) < 1e-9)}
    dofs = felupe.dof.partition(field, fixed)
    start, count = time.process_time(), 8
    try:
        for part in np.arange(1, count + 1) / count:
            load = felupe.PointLoad(field, np.arange(len(loads)), part * loads)
            felupe.newtonrhapson(items=[solid, load], dof0=dofs[0], dof1=dofs[1], verbose=0,
                                 maxiter=60, tol=1e-6)
    except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
        return Row(*FELUPE, f"did not converge ({error})", None)
    seconds = time.process_time() - start
    moved = (beam.end.weights @ field[0].values[beam.end.nodes])[0]
    return Row(*FELUPE,
               f"{seconds:.1f} s against {our_seconds:.2f} s; tip differs by"
               f" {100 * abs(moved / ours - 1):.3f} %; no tangent predictor or mixed-point Newton:"
               f" {count} load steps", None)


def _stvk(F: np.ndarray, lam: float, mu: float) -> np.ndarray:
    strain = 0.5 * (np.einsum("ki...,kj...->ij...", F, F) - np.eye(3)[:, :, None, None])
    return lam * np.einsum("kk...->...", strain) * np.eye(3)[:, :, None, None] + 2 * mu * strain


def _stvk_stress(x: list[np.ndarray], lam: float, mu: float) -> list[np.ndarray]:
    return [np.einsum("ik...,kj...->ij...", x[0], _stvk(x[0], lam, mu)), x[-1]]


def _stvk_elasticity(x: list[np.ndarray], lam: float, mu: float) -> list[np.ndarray]:
    F, eye = x[0], np.eye(3)
    square = np.einsum("ik...,jk...->ij...", F, F)
    return [lam * np.einsum("ij...,kl...->ijkl...", F, F)
            + mu * np.einsum("il...,kj...->ijkl...", F, F)
            + mu * np.einsum("ik...,jl->ijkl...", square, eye)
            + np.einsum("ik,jl...->ijkl...", eye, _stvk(F, lam, mu))]


def _skfem_row() -> Row:
    import skfem
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    from limber.mechanics import BranchModel, solve_static

    beam, loads, _, _ = _problem()
    linear = BranchModel(beam.mesh, young=YOUNG, poisson=0.35, density=1.0, gravity=None,
                         material="linear")
    start = time.process_time()
    result = solve_static(linear, nodal_forces=1e-3 * loads).require()
    our_seconds = time.process_time() - start
    corners = beam.mesh.linear()
    start = time.process_time()
    mesh = skfem.MeshTet(corners.nodes.T, corners.tets.T)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP2()))
    stiffness = skfem.asm(linear_elasticity(*lame_parameters(YOUNG, 0.35)), basis)
    solution = skfem.solve(*skfem.condense(
        stiffness, np.ones(basis.N), D=basis.get_dofs(lambda x: x[2] < 1e-9)))
    seconds = time.process_time() - start
    return Row(*SKFEM, f"assembly and solve {seconds:.1f} s against {our_seconds:.2f} s"
               f" ({solution.size} unknowns, ours converged: {result.converged})", None)
