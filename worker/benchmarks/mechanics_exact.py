"""Mechanics against exact solutions and its own convergence rates."""

import csv
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks import mechanics_reduced
from benchmarks.prescribed import solve_prescribed
from benchmarks.table import Asked, Row, Setting
from limber.core.numerics.rigid import rotation_matrix
from limber.geometry.tets.element_types import quadrature
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
from limber.mechanics.elements import shape_functions as fe
from limber.mechanics.statics.rest_shape import unloaded_rest_shape

ELASTICA = Path(__file__).parents[3] / "shared" / "data" / "elastica"
LENGTH, RADIUS, YOUNG, DENSITY = 0.6, 0.004, 5e7, 900.0
_UNDAMPED = RayleighDamping(0.0, 0.0)
_FREQUENCY = 1.87510407
# The manufactured solution: Young's modulus 1, Poisson's ratio 0.3, and its amplitude.
_LAMBDA, _MU = 0.3 / (1.3 * 0.4), 1 / 2.6
_AMPLITUDE = np.array([0.08, -0.05, 0.06])


_ASKED_ELASTICA = "0.7 % in w/L and u/L"
ELASTICA_ROWS = tuple(Asked(f"cantilever against the elastica: {load}", _ASKED_ELASTICA)
                      for load in ("dead tip load alpha 1, 2, 5, 10", "own weight beta 1, 3, 5, 10",
                                   "end moment ML/EI 0.5 ... pi", "taper 1, 0.7, 0.5, 0.3"))
ELEMENT_RATE = Asked("convergence rate in element size (energy, manufactured StVK solution)",
                     "4 +- 0.3")
TIME_RATE = Asked("convergence rate in the time step (undamped; viscous)", "2 +- 0.1")
EXACTNESS = (Asked("rigid motion: force and energy", "1e-10 relative"),
             Asked("patch test", "1e-10 relative"),
             Asked("finite differences of energy and force", "1e-6 relative"))
VIBRATION = Asked("undamped free vibration, 1,000 steps: first frequency; energy drift",
                  "1 % of the beam's; 1 %")
REST_SHAPE = Asked("inverse statics: gravity on the found rest shape gives the scan", "0.1 mm")


# --- exact solutions -------------------------------------------------------------------------


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
        return [Row(*asked, f"no data in {ELASTICA}", None, 0) for asked in ELASTICA_ROWS]
    beam = Cantilever.make()
    stiffness = YOUNG * beam.inertia
    found = []
    errors = []
    for row in _table("elastica_tip_load.csv", "alpha_PL2_over_EI", (1, 2, 5, 10)):
        force = row["alpha_PL2_over_EI"] * stiffness / LENGTH**2
        result = solve_static(beam.model(), grasp=beam.end, grasp_force=[force, 0, 0]).require()
        errors += beam.errors(result.displacement, row["delta_v_over_L"], row["delta_h_over_L"])
    found.append(_elastica_row(ELASTICA_ROWS[0], errors, beam))
    errors = []
    for row in _table("elastica_self_weight.csv", "beta_qL3_over_EI", (1, 3, 5, 10)):
        gravity = row["beta_qL3_over_EI"] * stiffness / LENGTH**3 / (DENSITY * beam.area)
        result = solve_static(beam.model((gravity, 0, 0))).require()
        errors += beam.errors(result.displacement, row["delta_v_over_L"], row["delta_h_over_L"])
    found.append(_elastica_row(ELASTICA_ROWS[1], errors, beam))
    errors = []
    for row in _table("end_moment_exact.csv", "ML_over_EI", (0.5, 1.0, 1.57079633, 3.14159265)):
        moved = _under_end_moment(beam, row["ML_over_EI"] * stiffness / LENGTH)
        errors += beam.errors(moved, row["delta_v_over_L"], row["delta_h_over_L"])
    found.append(_elastica_row(ELASTICA_ROWS[2], errors, beam))
    errors = []
    for row in _table("tapered_circular_small_deflection.csv", "r_tip_over_r_base",
                      (1.0, 0.7, 0.5, 0.3)):
        taper = Cantilever.make(row["r_tip_over_r_base"])
        force = 1e-3 * stiffness / LENGTH**2
        result = solve_static(taper.model(), grasp=taper.end, grasp_force=[force, 0, 0]).require()
        wanted = row["delta_tip_E_I0_over_P_L3_numeric"] * 1e-3
        middle = taper.end.weights @ result.displacement[taper.end.nodes]
        errors.append(100 * abs(middle[0] / LENGTH / wanted - 1))
    found.append(_elastica_row(ELASTICA_ROWS[3], errors, beam))
    return found


def _elastica_row(asked: Asked, errors: list[float], beam: Cantilever) -> Row:
    return Row(*asked, f"{max(errors):.2f} % at worst ({beam.mesh.tet_count} tetrahedra)",
               max(errors) <= 0.7)


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


# --- convergence -----------------------------------------------------------------------------


def element_rate_row(setting: Setting) -> list[Row]:
    """Error of the total potential of a manufactured large-strain solution on refined cubes."""
    exact = _exact_potential()
    cells = (4, 8) if setting.quick else (6, 12)
    coarse, fine = (_manufactured_potential(n) - exact for n in cells)
    rate = np.log2(coarse / fine)
    return [Row(*ELEMENT_RATE, f"{rate:.2f}", bool(abs(rate - 4) <= 0.3))]


def _exact_potential() -> float:
    places, weights = np.polynomial.legendre.leggauss(24)
    places, weights = (places + 1) / 2, weights / 2
    points = np.stack(np.meshgrid(places, places, places, indexing="ij"), axis=-1).reshape(-1, 3)
    weight = np.einsum("i,j,k->ijk", weights, weights, weights).ravel()
    F = np.eye(3) + _smooth_gradient(points)
    strain = 0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(3))
    energy = (0.5 * _LAMBDA * np.trace(strain, axis1=1, axis2=2)**2
              + _MU * (strain**2).sum(axis=(1, 2)))
    moved = _AMPLITUDE * np.prod(np.sin(np.pi * points), axis=1)[:, None]
    work = -(_divergence(points) * moved).sum(axis=1)
    return float(weight @ (energy - work))


def _manufactured_potential(cells: int) -> float:
    mesh = _cube(cells)
    model = BranchModel(mesh, young=1.0, poisson=0.3, density=1.0, gravity=None,
                        fixed=(np.abs(mesh.nodes - 0.5) > 0.5 - 1e-9).any(axis=1))
    rule = quadrature(5)
    shape = fe.shape_functions(rule.points, 10)
    corners = mesh.nodes[mesh.tets[:, :4]]
    places = np.einsum("qc,ecx->eqx", rule.points, corners)
    load = -_divergence(places.reshape(-1, 3)).reshape(places.shape)
    weights = mesh.volumes[:, None] * rule.weights
    forces = np.zeros_like(mesh.nodes)
    np.add.at(forces, mesh.tets, np.einsum("eq,qa,eqx->eax", weights, shape, load))
    result = solve_prescribed(model, np.zeros_like(forces), nodal_forces=forces,
                              settings=StaticSettings(tolerance=1e-11)).require()
    return result.strain_energy - float((forces * result.displacement).sum())


def _smooth_gradient(points: np.ndarray) -> np.ndarray:
    """Gradient of u = amplitude sin(pi x) sin(pi y) sin(pi z), shape [n, 3, 3]."""
    s, c = np.sin(np.pi * points), np.pi * np.cos(np.pi * points)
    slope = np.stack([c[:, 0] * s[:, 1] * s[:, 2], s[:, 0] * c[:, 1] * s[:, 2],
                      s[:, 0] * s[:, 1] * c[:, 2]], axis=1)
    return _AMPLITUDE[None, :, None] * slope[:, None, :]


def _first_stress(points: np.ndarray) -> np.ndarray:
    F = np.eye(3) + _smooth_gradient(points)
    strain = 0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(3))
    trace = np.trace(strain, axis1=1, axis2=2)[:, None, None]
    return F @ (_LAMBDA * trace * np.eye(3) + 2 * _MU * strain)


def _divergence(points: np.ndarray) -> np.ndarray:
    total, h = np.zeros_like(points), 1e-3
    for axis in range(3):
        shift = h * np.eye(3)[axis]
        near = _first_stress(points + shift) - _first_stress(points - shift)
        far = _first_stress(points + 2 * shift) - _first_stress(points - 2 * shift)
        total += ((8 * near - far) / (12 * h))[:, :, axis]
    return total


def _cube(cells: int) -> TetMesh:
    from itertools import permutations, product

    line = np.linspace(0, 1, cells + 1)
    nodes = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    tets, strides = [], np.array([(cells + 1)**2, cells + 1, 1])
    for cell in product(range(cells), repeat=3):
        first = int(np.dot(cell, strides))
        for turn in permutations(range(3)):
            tets.append(first + np.concatenate([[0], np.cumsum(strides[list(turn)])]))
    return TetMesh(nodes, np.array(tets)).oriented().quadratic()


def short_beam(slices: int = 16) -> tuple[TetMesh, Grasp]:
    mesh = straight_beam(0.2, 0.005, slice_count=slices)
    return mesh, Grasp.of_nodes(mesh, np.flatnonzero(mesh.nodes[:, 2] > 0.2 - 1e-9), "point")


def time_rate_row(_setting: Setting) -> list[Row]:
    """Halved steps of a large swing, undamped and viscous."""
    mesh, tip = short_beam(8)
    rates, end = [], 0.24
    for damping in (_UNDAMPED, RayleighDamping(1.0, 0.01)):
        model = BranchModel(mesh, young=1e7, poisson=0.3, density=DENSITY, gravity=None,
                            damping=damping)
        ends = []
        for count in (48, 96, 192):
            times = np.linspace(0, end, count + 1)
            pull = np.outer(np.sin(np.pi * times / end)**2, [0.25, 0.1, 0.0])
            ends.append(simulate_dynamics(
                model, grasp=tip, grasp_forces=pull, times=times, start="rest",
                settings=NewmarkSettings(max_step=1.0, tolerance=1e-9),
            ).require().displacement[-1])
        first, second = (np.linalg.norm(a - b) for a, b in pairwise(ends))
        rates.append(np.log2(first / second))
    return [Row(*TIME_RATE, f"{rates[0]:.2f}; {rates[1]:.2f}",
                bool(max(abs(r - 2) for r in rates) <= 0.1))]


def exactness_rows(setting: Setting) -> list[Row]:
    """Rigid motion, patch test, finite differences."""
    mesh = _cube(3)
    rng = setting.generator(51)
    model = BranchModel(mesh, young=rng.uniform(1, 3, mesh.tet_count), poisson=0.3, density=1.0,
                        gravity=None, fixed=(np.abs(mesh.nodes - 0.5) > 0.5 - 1e-9).any(axis=1))
    turn = rotation_matrix(np.array([0.9, -1.4, 0.7]))
    turned = model.internal(mesh.nodes @ turn.T + [4.0, -2, 1] - mesh.nodes)
    stretched = model.internal(0.01 * mesh.nodes)
    rigid = max(np.linalg.norm(turned.force) / np.linalg.norm(stretched.force),
                abs(turned.strain_energy) / stretched.strain_energy)
    linear_map = mesh.nodes @ np.array([[0.02, 0.01, 0], [0.03, -0.01, 0.02], [0, 0.01, 0.03]])
    plain = BranchModel(mesh, young=1.0, poisson=0.3, density=1.0, gravity=None,
                        fixed=model.fixed)
    patch = solve_prescribed(plain, linear_map).require().displacement
    miss = np.abs(patch - linear_map).max() / np.abs(linear_map).max()
    u, d = 0.02 * rng.standard_normal(mesh.nodes.shape), rng.standard_normal(mesh.nodes.shape)
    h = 1e-6
    ahead, behind = model.internal(u + h * d), model.internal(u - h * d)
    by_energy = (ahead.strain_energy - behind.strain_energy) / (2 * h)
    differences = max(
        abs(by_energy / (model.internal(u).force * d).sum() - 1),
        np.linalg.norm((ahead.force - behind.force) / (2 * h) - model.tangent_times(u, d))
        / np.linalg.norm(model.tangent_times(u, d)))
    return [Row(*EXACTNESS[0], f"{rigid:.1e}", bool(rigid < 1e-10)),
            Row(*EXACTNESS[1], f"{miss:.1e}", bool(miss < 1e-10)),
            Row(*EXACTNESS[2], f"{differences:.1e}", bool(differences < 1e-6))]


def vibration_row(_setting: Setting) -> list[Row]:
    """1,000 undamped steps of a released bent beam."""
    mesh, tip = short_beam()
    area, inertia = section(mesh)
    model = BranchModel(mesh, young=1e7, poisson=0.3, density=DENSITY, gravity=None,
                        damping=_UNDAMPED)
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
    return [Row(*VIBRATION, f"{off:.2f} %; {drift:.3f} %", bool(off <= 1 and drift <= 1))]


def rest_shape_row(_setting: Setting) -> list[Row]:
    """Gravity on the found rest shape of a branch that sags by a fifth of its length."""
    mesh = mechanics_reduced.bench_branch(2.0).model.mesh
    model = BranchModel(mesh, young=1.5e8, poisson=0.35, density=DENSITY,
                        gravity=(0.0, -9.80665, 0.0))
    shape = unloaded_rest_shape(model)
    loaded = solve_static(model.with_rest_nodes(shape.nodes)).require()
    miss = 1e3 * np.linalg.norm(shape.nodes + loaded.displacement - mesh.nodes, axis=1).max()
    sag = 1e3 * np.linalg.norm(shape.nodes - mesh.nodes, axis=1).max()
    return [Row(*REST_SHAPE, f"{miss:.4f} mm (a sag of {sag:.0f} mm)", bool(miss <= 0.1))]
