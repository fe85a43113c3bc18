"""Mechanics: exact solutions, the clock, the reduced model, other programs.

Times are processor seconds of this process, the least of several runs, which other work on the
machine affects least. Ratios are taken within one run.
"""

import csv
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import psutil

from benchmarks import mechanics_reduced as reduced
from benchmarks.table import Asked, Part, Row, Setting
from limber.core.processes import Pool
from limber.geometry.tets.tet_mesh import TetMesh
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import (
    BranchModel,
    Grasp,
    NewmarkSettings,
    RayleighDamping,
    StaticResult,
    StaticSettings,
    follow_poses,
    simulate_dynamics,
    solve_static,
)
from limber.mechanics.linear.equations import CholmodFactor
from limber.mechanics.materials.materials import lame

ELASTICA = Path(__file__).parents[3] / "shared" / "data" / "elastica"
LENGTH, RADIUS, YOUNG, DENSITY = 0.6, 0.004, 5e7, 900.0
_FREQUENCY = 1.87510407

_ELASTICA = tuple(Asked(f"cantilever against the elastica: {load}", "0.7 % in w/L and u/L")
                  for load in ("dead tip load alpha 1, 2, 5, 10", "own weight beta 1, 3, 5, 10",
                               "end moment ML/EI 0.5 ... pi", "taper 1, 0.7, 0.5, 0.3"))
_VIBRATION = Asked("undamped free vibration, 1,000 steps: first frequency; energy drift",
                   "1 % of the beam's; 1 %")
_SPEED = (
    Asked("assembly of stiffness and force, 2,800 quadratic tetrahedra, one thread",
          "under 30 % of the factorisation"),
    Asked("converged implicit step, same mesh, dt 1/60",
          "under 3.2 times (assembly + factorisation + solve)"),
    Asked("converged implicit steps, 1,000 quadratic tetrahedra", "40 steps a second"))
_LINEAR = Asked("linear tetrahedra, one-Newton step, 7,500 tetrahedra",
                "12 ms where the prototype took 11.6")
_GRASPS = Asked("300 random grasps to 40 % of the length, full model, one process",
                "105 s; no false equilibrium")
_MEMORY = Asked("memory at 50,000 quadratic tetrahedra", "4 GB, and it solves")
_FELUPE = Asked("peer: felupe, same mesh, material and load (alpha 2)", "-")
_SKFEM = Asked("peer: scikit-fem, same mesh, linear elasticity (no large deflection as shipped)",
               "-")


# --- exact solutions ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Cantilever:
    """A slender round beam of about 1,500 quadratic tetrahedra along z, and its end face."""

    mesh: TetMesh
    end: Grasp
    inertia: float
    area: float

    @classmethod
    def make(cls, ratio: float = 1.0, slices: int = 83) -> "Cantilever":
        mesh = straight_beam(LENGTH, RADIUS, RADIUS * ratio, slice_count=slices)
        end = Grasp.of_nodes(mesh, np.flatnonzero(mesh.nodes[:, 2] > LENGTH - 1e-9), "point")
        area, inertia = section(mesh)
        return cls(mesh, end, inertia, area)

    def model(self, gravity: tuple[float, float, float] | None = None) -> BranchModel:
        return BranchModel(self.mesh, young=YOUNG, poisson=0.35, density=DENSITY, gravity=gravity)

    def errors(self, moved: np.ndarray, sideways: float, shortening: float) -> list[float]:
        """Relative errors [%] of the end's motion [m, 3] in w/L and u/L."""
        middle = self.end.weights @ moved[self.end.nodes] / LENGTH
        return [100 * abs(np.linalg.norm(middle[:2]) / sideways - 1),
                100 * abs(-middle[2] / shortening - 1)]


def section(mesh: TetMesh) -> tuple[float, float]:
    """Return area [m^2] and second moment [m^4] of the polygon at z = 0."""
    corners = mesh.nodes[np.unique(mesh.tets[:, :4])]
    base = corners[np.abs(corners[:, 2]) < 1e-9][:, :2]
    radius = np.linalg.norm(base, axis=1)
    ring = base[radius > radius.max() - 1e-9]
    ring = ring[np.argsort(np.arctan2(ring[:, 1], ring[:, 0]))]
    after = np.roll(ring, -1, axis=0)
    cross = ring[:, 0] * after[:, 1] - after[:, 0] * ring[:, 1]
    second = cross * (ring[:, 0]**2 + ring[:, 0] * after[:, 0] + after[:, 0]**2)
    return float(cross.sum() / 2), float(second.sum() / 12)


def elastica_rows(_setting: Setting) -> list[Row]:
    """Tip load, own weight, end moment and taper against the reference tables."""
    if not ELASTICA.is_dir():
        return [Row(*asked, f"no data in {ELASTICA}", None, 0) for asked in _ELASTICA]
    beam = Cantilever.make()
    stiffness = YOUNG * beam.inertia

    def pushed(alpha: float, on: Cantilever = beam) -> np.ndarray:
        return solve_static(on.model(), grasp=on.end, grasp_force=[
            alpha * stiffness / LENGTH**2, 0, 0]).require().displacement

    def heavy(beta: float) -> np.ndarray:
        gravity = beta * stiffness / LENGTH**3 / (DENSITY * beam.area)
        return solve_static(beam.model((gravity, 0, 0))).require().displacement

    errors: list[list[float]] = []
    for file, key, wanted, bent in (
            ("elastica_tip_load.csv", "alpha_PL2_over_EI", (1, 2, 5, 10), pushed),
            ("elastica_self_weight.csv", "beta_qL3_over_EI", (1, 3, 5, 10), heavy),
            ("end_moment_exact.csv", "ML_over_EI", (0.5, 1.0, 1.57079633, 3.14159265),
             lambda size: _under_end_moment(beam, size * stiffness / LENGTH))):
        errors.append([error for row in _table(file, key, wanted) for error in beam.errors(
            bent(row[key]), row["delta_v_over_L"], row["delta_h_over_L"])])
    errors.append([])
    for row in _table("tapered_circular_small_deflection.csv", "r_tip_over_r_base",
                      (1.0, 0.7, 0.5, 0.3)):
        taper = Cantilever.make(row["r_tip_over_r_base"])
        middle = taper.end.weights @ pushed(1e-3, taper)[taper.end.nodes]
        wanted = row["delta_tip_E_I0_over_P_L3_numeric"] * 1e-3
        errors[-1].append(100 * abs(middle[0] / LENGTH / wanted - 1))
    return [Row(*asked, f"{max(each):.2f} % at worst ({beam.mesh.tet_count} tetrahedra)",
                max(each) <= 0.7) for asked, each in zip(_ELASTICA, errors, strict=True)]


def _table(name: str, key: str, wanted: tuple[float, ...]) -> list[dict[str, float]]:
    with (ELASTICA / name).open() as stream:
        table = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(stream)]
    return [row for row in table if any(abs(row[key] - value) < 1e-6 for value in wanted)]


def _under_end_moment(beam: Cantilever, moment: float) -> np.ndarray:
    """Return the displacement under a moment about y that turns with the end face.

    Dead forces on the face would be another load, and an unstable one. The face is held, and its
    position and rotation are sought at which it takes the moment and no force.
    """
    model, face = beam.model(), replace(beam.end, mode="rigid")
    angle = moment * LENGTH / (YOUNG * beam.inertia)
    parts = np.linspace(0, 1, int(np.ceil(angle / 0.3)) + 1)[1:]
    result = follow_poses(model, face, np.array([_arc_pose(part * angle) for part in parts])
                          )[-1].require()
    place = result.pose[[0, 2, 4]]
    scale = np.array([1e-4, 1e-4, 1e-3])

    def left(values: np.ndarray) -> tuple[np.ndarray, StaticResult]:
        pose = np.array([values[0], 0, values[1], 0, values[2], 0])
        found = solve_static(model, grasp=face, pose=pose, start=result).require()
        force, torque = found.reaction_force, found.reaction_torque
        return np.array([force[0] * LENGTH, force[2] * LENGTH, torque[1] - moment]), found

    for _ in range(3):
        now, result = left(place)
        slope = np.stack([(left(place + scale * axis)[0] - now) / (scale @ axis)
                          for axis in np.eye(3)], axis=1)
        place = place - np.linalg.solve(slope, now)
    return left(place)[1].displacement


def _arc_pose(angle: float) -> np.ndarray:
    radius = LENGTH / angle
    return np.array([radius * (1 - np.cos(angle)), 0, radius * np.sin(angle), 0, angle, 0])


def vibration_row(_setting: Setting) -> list[Row]:
    """1,000 undamped steps of a released bent beam."""
    mesh = straight_beam(0.2, 0.005, slice_count=16)
    tip = Grasp.of_nodes(mesh, np.flatnonzero(mesh.nodes[:, 2] > 0.2 - 1e-9), "point")
    area, inertia = section(mesh)
    model = BranchModel(mesh, young=1e7, poisson=0.3, density=DENSITY, gravity=None,
                        damping=RayleighDamping(0.0, 0.0))
    bent = solve_static(model, grasp=tip, grasp_force=[0.004, 0, 0]).require()
    frequency = _FREQUENCY**2 / (2 * np.pi * 0.2**2) * np.sqrt(1e7 * inertia / (DENSITY * area))
    step = 1 / frequency / 100
    times = step * np.arange(1001)
    result = simulate_dynamics(model, times=times, start=bent,
                               settings=NewmarkSettings(max_step=step)).require()
    sway = result.displacement[:, tip.nodes, 0].mean(axis=1)
    down = np.flatnonzero((sway[:-1] > 0) & (sway[1:] <= 0))
    exact = times[down] + step * sway[down] / (sway[down] - sway[down + 1])
    off = 100 * abs(1 / np.diff(exact).mean() / frequency - 1)
    energy = result.strain_energy + result.kinetic_energy
    drift = 100 * np.abs(energy / energy[0] - 1).max()
    return [Row(*_VIBRATION, f"{off:.2f} %; {drift:.3f} %", bool(off <= 1 and drift <= 1))]


# --- the clock ---------------------------------------------------------------------------------


def _sized_mesh(tet_count: int) -> TetMesh:
    """Return the branch with this many quadratic tetrahedra, or the next larger number."""
    spacings = np.geomspace(0.15, 6, 24)
    low, high = 0, len(spacings) - 1
    meshes = {}
    while high - low > 1:
        middle = (low + high) // 2
        meshes[middle] = reduced.bench_branch(float(spacings[middle])).model.mesh
        low, high = (middle, high) if meshes[middle].tet_count > tet_count else (low, middle)
    enough = [mesh for mesh in meshes.values() if mesh.tet_count >= tet_count]
    return min(enough, key=lambda mesh: mesh.tet_count)


def least_seconds(work: Callable[[], object], count: int = 15) -> float:
    """Return the least processor time [s] of ``work`` after one run to warm up."""
    work()
    times = []
    for _ in range(count):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


@dataclass(frozen=True)
class Parts:
    """Processor times [s] of the parts of an iteration."""

    assembly: float
    factorisation: float
    solve: float

    @property
    def total(self) -> float:
        return self.assembly + self.factorisation + self.solve


def parts_of(model: BranchModel, count: int = 15) -> Parts:
    """Time assembly of force and stiffness, factorisation and solve.

    One after the other as in an iteration, so that each finds the caches in the same state; the
    least of each.
    """
    equations = model.equations()
    zero = np.zeros_like(model.mesh.nodes)
    right = np.ones_like(zero)
    times = []
    for _ in range(count + 1):
        stamps = [time.process_time()]
        model.internal(zero)
        values = equations.assemble(model, zero)
        stamps.append(time.process_time())
        tangent = equations.factorised(values)
        stamps.append(time.process_time())
        tangent.solve(right)
        stamps.append(time.process_time())
        times.append(np.diff(stamps))
    return Parts(*np.min(times[1:], axis=0))


def cholmod_seconds(model: BranchModel) -> float:
    """Return the least time [s] in which CHOLMOD factorises the model's assembled matrix."""
    equations = model.equations()
    values = equations.assemble(model, np.zeros_like(model.mesh.nodes))
    pattern = equations.pattern
    general = CholmodFactor(*pattern.entries(), pattern.size)
    return least_seconds(lambda: general.factorise(values), 7)


def _stepping(model: BranchModel, count: int = 40) -> tuple[float, float]:
    """Return processor seconds and iterations of a converged step, dt 1/60, load at the tip."""
    tip = int(model.mesh.nodes[:, 2].argmax())
    force = np.zeros_like(model.mesh.nodes)
    force[tip, 0] = 0.05
    settings = NewmarkSettings(tolerance=1e-4)
    best, iterations = np.inf, 0.0
    for _ in range(3):
        start = time.process_time()
        result = simulate_dynamics(model, nodal_forces=force, times=np.arange(count + 1) / 60,
                                   start="rest", settings=settings).require()
        best = min(best, (time.process_time() - start) / count)
        iterations = result.iteration_count / result.step_count
    return best, iterations


def speed_rows(setting: Setting) -> list[Row]:
    """Assembly against factorisation, converged steps."""
    found = []
    model = _branch_model(_sized_mesh(2800))
    parts, general = parts_of(model), cholmod_seconds(model)
    ratio = 100 * parts.assembly / parts.factorisation
    count = model.mesh.tet_count
    found.append(Row(
        *_SPEED[0],
        f"{ratio:.0f} % ({count} tetrahedra; {1e3 * parts.assembly:.1f} of"
        f" {1e3 * parts.factorisation:.1f} ms;"
        f" CHOLMOD, which the row was set for, takes {1e3 * general:.1f} ms:"
        f" {100 * parts.assembly / general:.0f} %; prototype 7.1 of 27.1)", bool(ratio < 30)))
    step, iterations = _stepping(model, setting.at_most(40, 20))
    units = step / parts.total
    found.append(Row(
        *_SPEED[1],
        f"{units:.2f} times ({1e3 * step:.0f} ms, {iterations:.1f} iterations, residual 1e-4;"
        " prototype 91 ms)", bool(units < 3.2)))
    small = _branch_model(_sized_mesh(1000))
    step, _ = _stepping(small, setting.at_most(40, 20))
    found.append(Row(
        *_SPEED[2], f"{1 / step:.0f} a second ({small.mesh.tet_count} tetrahedra; "
        "prototype 35)", bool(1 / step >= 40)))
    return found


def _branch_model(mesh: TetMesh) -> BranchModel:
    return BranchModel(mesh, young=YOUNG, poisson=0.35, density=DENSITY, gravity=None)


def linear_row(_setting: Setting) -> list[Row]:
    """One Newton step in time with linear tetrahedra."""
    mesh = _sized_mesh(7500).linear()
    model = _branch_model(mesh)
    equations = model.equations()
    zero = np.zeros_like(mesh.nodes)
    right = np.ones_like(zero)

    def step() -> None:
        model.internal(zero)
        tangent = equations.tangent(model, zero, mass_factor=14400.0)
        tangent.solve(right - model.mass_matrix @ zero)

    seconds = least_seconds(step)
    return [Row(*_LINEAR, f"{1e3 * seconds:.1f} ms ({mesh.tet_count} tetrahedra)",
                bool(seconds <= 0.012))]


def grasp_row(setting: Setting) -> list[Row]:
    """Random grasps to 40 % of the length by the full model, each solved on two paths."""
    count = setting.at_most(300, 40)
    model = _branch_model(_sized_mesh(2800))
    reach = 2 / 3 * LENGTH
    grasp = Grasp.at(model.mesh, model.mesh.nodes[_node_at(model.mesh, reach)], 0.0, "point")
    poses = np.array([np.concatenate([grasp.centre + move, np.zeros(3)])
                      for move in _tour(grasp.centre, count, setting.generator(52))])
    start = time.process_time()
    results = follow_poses(model, grasp, poses)
    seconds = time.process_time() - start
    careful = StaticSettings(max_step=0.1)
    again = follow_poses(model, grasp, poses[::-1], settings=careful)[::-1]
    both = [(a, b) for a, b in zip(results, again, strict=True) if a.converged and b.converged]
    off = [abs(a.strain_energy / b.strain_energy - 1) for a, b in both]
    false = sum(a.strain_energy > (1 + 1e-3) * b.strain_energy for a, b in both)
    failed = sum(not r.converged for r in results)
    lowest = min(r.min_det_f for r in results)
    measured = (f"{seconds:.0f} s for {count} ({seconds * 300 / count:.0f} s for 300; prototype"
                f" 104); {failed} failed; min det F {lowest:.2f}; energy on the way back differs"
                f" by {max(off):.1e} at most; {false} higher than there")
    return [Row(*_GRASPS, measured, bool(
        seconds * 300 / count <= 105 and not false and lowest > 0 and not failed), count)]


def _node_at(mesh: TetMesh, height: float) -> int:
    corners = np.unique(mesh.tets[:, :4])
    main = corners[mesh.nodes[corners, 0] > 0.2 * mesh.nodes[corners, 2] - 0.02]
    return int(main[np.abs(np.linalg.norm(mesh.nodes[main], axis=1) - height).argmin()])


def _tour(centre: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return reachable random moves [m] in the order of nearest neighbours, [count, 3]."""
    moves: list[np.ndarray] = []
    while len(moves) < count:
        move = rng.standard_normal(3)
        move *= 0.4 * LENGTH * rng.uniform() ** (1 / 3) / np.linalg.norm(move)
        place = centre + move
        if 0.4 < np.linalg.norm(place) / np.linalg.norm(centre) < 0.97 and place[2] > 0.05:
            moves.append(move)
    left, order, at = list(range(count)), [], np.zeros(3)
    while left:
        nearest = min(left, key=lambda k: float(np.linalg.norm(moves[k] - at)))
        order.append(nearest)
        left.remove(nearest)
        at = moves[nearest]
    return np.array([moves[k] for k in order])


def memory_row(setting: Setting) -> list[Row]:
    """A static solve with 50,000 quadratic tetrahedra, in a process of its own."""
    count = setting.at_most(50_000, 10_000)
    with Pool(1) as pool:
        found, megabytes, seconds, converged = pool.submit(_solve_large, count).result()
    is_met = None if setting.quick else bool(converged and megabytes < 4096 and found >= 45_000)
    return [Row(*_MEMORY, f"{megabytes / 1024:.2f} GB at {found} tetrahedra,"
                f" {'solved' if converged else 'not solved'} in {seconds:.0f} s", is_met)]


def _solve_large(count: int) -> tuple[int, float, float, bool]:
    mesh = straight_beam(LENGTH, 0.01, slice_count=count // (3 * 24), sides=24)
    model = BranchModel(mesh, young=YOUNG, poisson=0.35, density=DENSITY)
    start = time.perf_counter()
    grasp = Grasp.at(mesh, np.array([0, 0, 0.4]), 0.012)
    pose = grasp.rest_pose + np.array([0.05, 0, -0.004, 0, 0.1, 0])
    result = solve_static(model, grasp=grasp, pose=pose)
    process = psutil.Process()
    memory = process.memory_info()
    peak = getattr(memory, "peak_wset", None)
    if peak is None:
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return mesh.tet_count, peak / 2**20, time.perf_counter() - start, result.converged


# --- other programs on the same cantilever, if their wheels are installed ----------------------


def felupe_row(_setting: Setting) -> list[Row]:
    """Measure felupe, or report that it is not installed."""
    return [_felupe_row() if find_spec("felupe") else _absent(_FELUPE)]


def skfem_row(_setting: Setting) -> list[Row]:
    """Measure scikit-fem, or report that it is not installed."""
    return [_skfem_row() if find_spec("skfem") else _absent(_SKFEM)]


def _absent(asked: Asked) -> Row:
    return Row(*asked, "not installed (pip install felupe scikit-fem)", None, 0)


def _problem() -> tuple:
    beam = Cantilever.make()
    force = 2 * YOUNG * beam.inertia / LENGTH**2
    start = time.process_time()
    result = solve_static(beam.model(), grasp=beam.end, grasp_force=[force, 0, 0]).require()
    seconds = time.process_time() - start
    moved = (beam.end.weights @ result.displacement[beam.end.nodes])[0]
    loads = np.zeros_like(beam.mesh.nodes)
    loads[beam.end.nodes, 0] = force * beam.end.weights
    return beam, loads, moved, seconds


def _felupe_row() -> Row:
    import felupe

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
        return Row(*_FELUPE, f"did not converge ({error})", None)
    seconds = time.process_time() - start
    moved = (beam.end.weights @ field[0].values[beam.end.nodes])[0]
    return Row(*_FELUPE,
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
    return Row(*_SKFEM, f"assembly and solve {seconds:.1f} s against {our_seconds:.2f} s"
               f" ({solution.size} unknowns, ours converged: {result.converged})", None)

PARTS = {
    "elastica": Part(elastica_rows, 10, _ELASTICA),
    "vibration": Part(vibration_row, 5, (_VIBRATION,)),
    "reduced": Part(reduced.pinned_rows, 180, reduced.PINNED_ROWS),
    "steps": Part(speed_rows, 15, _SPEED),
    "grasps": Part(grasp_row, 120, (_GRASPS,)),
    "linear": Part(linear_row, 5, (_LINEAR,)),
    "memory": Part(memory_row, 20, (_MEMORY,)),
    "felupe": Part(felupe_row, 60, (_FELUPE,)),
    "scikit-fem": Part(skfem_row, 15, (_SKFEM,))}
"""The table, in order of importance."""
