"""Mechanics against the clock.

Times are processor seconds of this process, the least of several runs, which other work on the
machine affects least. Ratios are taken within one run.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.mechanics_exact import DENSITY, LENGTH, YOUNG
from benchmarks.mechanics_reduced import bench_branch
from benchmarks.table import Asked, Row, Setting
from limber.core.processes import Pool
from limber.geometry.tets.tet_mesh import TetMesh
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import (
    BranchModel,
    Grasp,
    NewmarkSettings,
    StaticSettings,
    follow_poses,
    simulate_dynamics,
    solve_static,
)

SPEED_ROWS = (
    Asked("assembly of stiffness and force, 2,800 quadratic tetrahedra, one thread",
          "under 30 % of the factorisation"),
    Asked("converged implicit step, same mesh, dt 1/60",
          "under 3.2 times (assembly + factorisation + solve)"),
    Asked("converged implicit steps, 1,000 quadratic tetrahedra", "40 steps a second"))
LINEAR = Asked("linear tetrahedra, one-Newton step, 7,500 tetrahedra",
               "12 ms where the prototype took 11.6")
GRASPS = Asked("300 random grasps to 40 % of the length, full model, one process",
               "105 s; no false equilibrium")
MEMORY = Asked("memory at 50,000 quadratic tetrahedra", "4 GB, and it solves")


def bench_mesh(spacing: float) -> TetMesh:
    """Return the notes' branch (0.6 m, radius 6 to 2 mm, curved, one fork), by the sweep."""
    return bench_branch(spacing).model.mesh


def _sized_mesh(tet_count: int) -> TetMesh:
    """Return the branch with this many quadratic tetrahedra, or the next larger number."""
    spacings = np.geomspace(0.15, 6, 24)
    low, high = 0, len(spacings) - 1
    meshes = {}
    while high - low > 1:
        middle = (low + high) // 2
        meshes[middle] = bench_mesh(float(spacings[middle]))
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
    from limber.mechanics.linear.equations import CholmodFactor

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
        *SPEED_ROWS[0],
        f"{ratio:.0f} % ({count} tetrahedra; {1e3 * parts.assembly:.1f} of"
        f" {1e3 * parts.factorisation:.1f} ms;"
        f" CHOLMOD, which the row was set for, takes {1e3 * general:.1f} ms:"
        f" {100 * parts.assembly / general:.0f} %; prototype 7.1 of 27.1)", bool(ratio < 30)))
    step, iterations = _stepping(model, setting.at_most(40, 20))
    units = step / parts.total
    found.append(Row(
        *SPEED_ROWS[1],
        f"{units:.2f} times ({1e3 * step:.0f} ms, {iterations:.1f} iterations, residual 1e-4;"
        " prototype 91 ms)", bool(units < 3.2)))
    small = _branch_model(_sized_mesh(1000))
    step, _ = _stepping(small, setting.at_most(40, 20))
    found.append(Row(
        *SPEED_ROWS[2], f"{1 / step:.0f} a second ({small.mesh.tet_count} tetrahedra; "
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
    return [Row(*LINEAR, f"{1e3 * seconds:.1f} ms ({mesh.tet_count} tetrahedra)",
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
    return [Row(*GRASPS, measured, bool(
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
    is_met = None if setting.quick else bool(
        converged and megabytes < 4096 and found >= 45_000)
    return [Row(*MEMORY, f"{megabytes / 1024:.2f} GB at {found} tetrahedra,"
                f" {'solved' if converged else 'not solved'} in {seconds:.0f} s", is_met)]


def _solve_large(count: int) -> tuple[int, float, float, bool]:
    import psutil

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
