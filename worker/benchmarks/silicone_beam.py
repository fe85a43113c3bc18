"""The recorded silicone beam, as a user imports it: Young's modulus from a hung weight.

Surface to branch folder, recording to pull, pull to modulus, modulus to other loads: the stages
behind ``limber mesh``, ``import-pull``, ``estimate`` and ``predict``, nothing else. The inputs
given here are those of a user: density, Poisson's ratio, positions of markers and load.

Other loads are predicted; the accuracy is measured on recordings of the same form, simulated on a
finer mesh of another kind.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from limber.estimation.prediction import PredictSettings
from limber.estimation.settings import EstimateSettings
from limber.geometry.bodies import MeshSurfaceSettings
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.statics.solve import solve_static
from limber.recordings.settings import ImportSettings
from limber.recordings.time_series import Stream, write_stream
from limber.stages.moduli.estimate import estimate
from limber.stages.moduli.predict import predict
from limber.stages.pulls.import_pull import import_pull
from limber.stages.shape.mesh import mesh_surface

FOLDER = Path(__file__).parents[3] / "shared/data/silicone_beam"
RECORDING, RECORDING_C3D = FOLDER / "beam_load52_V2_a.csv", FOLDER / "beam_load52_V2_a.c3d"
SIZE_M = (0.1, 0.03, 0.03)
DENSITY, POISSON = 1070.0, 0.49
GRAVITY = (0.0, 0.0, -9.80709)
LOAD_N = 0.51012
LABELS = ("tip1", "tip2", "tip3", "base1", "base2", "base3")
NOMINAL_M = np.array([[0, .015, .036], [0, -.006, .024], [0, .036, .006],
                      [-.094, -.01, -.001], [-.094, .04, .0275], [-.094, .04, 0]])
LOAD_POINT_M = np.array([0.0, 0.015, 0.03])
TIPS = slice(0, 3)


@dataclass(frozen=True)
class BeamResult:
    """Result of a recording.

    Attributes:
        young: Young's modulus [Pa].
        interval: 95 % interval, mesh included [Pa].
        sensor, mesh: Relative standard deviations by cause.
        measured_drop, simulated_drop: Mean drop of the tip markers, downwards [m].
    """

    young: float
    interval: tuple[float, float]
    sensor: float
    mesh: float
    measured_drop: float
    simulated_drop: float


def in_scan(points: np.ndarray) -> np.ndarray:
    """Transform points of the beam's frame [m] to that of ``beam.stl`` [m]: long axis z, y up."""
    return np.asarray(points)[..., [1, 2, 0]] + [0.0, 0.0, SIZE_M[0]]


def made_branch(folder: Path) -> Path:
    """The branch folder of ``beam.stl``, clamped at its far face, with the marker table."""
    branch = folder / "beam.branch"
    mesh_surface(FOLDER / "beam.stl", branch, MeshSurfaceSettings(
        unit="mm", up=(0.0, 1.0, 0.0), root=(15.0, 15.0, 0.0), poisson=POISSON,
        density=DENSITY))
    rows = [f"{label},{x:.6f},{y:.6f},{z:.6f}" for label, (x, y, z) in
            zip(LABELS, in_scan(NOMINAL_M), strict=True)]
    (folder / "nominal.csv").write_text("\n".join(["label,x_m,y_m,z_m", *rows]) + "\n")
    return branch


def estimate_beam(branch: Path, recording: Path, load: float, name: str) -> BeamResult:
    """Import a recording and estimate one modulus from it."""
    x, y, z = in_scan(LOAD_POINT_M)
    pull = import_pull(branch, recording, name, ImportSettings(
        nominal=str(branch.parent / "nominal.csv"), coordinates="scan", weight=load,
        own_weight=True, grasp_point=(float(x), float(y), float(z)), grasp_radius=0.012))
    found = estimate(branch, EstimateSettings(pull=(name,), fractions=(0.5,), density_sigma=0.02),
                     force=True)
    down = -np.array(pull["load_n"]) / load
    measured = -np.mean(np.array(pull["displacement_m"])[TIPS] @ down)
    deviation = found["young_deviation"]
    low, high = found["young_interval_pa"][0]
    return BeamResult(float(found["young_pa"][0]), (float(low), float(high)),
                      float(deviation["sensor"][0]), float(deviation["mesh"][0]),
                      float(measured), predicted_drop(branch, name, load))


def creep() -> float:
    """Fraction by which the given recording's drop still grows, from the fourth last second to the
    last: the swing has died out by then.
    """
    table = np.loadtxt(RECORDING, delimiter=",", skiprows=1)
    left, tips = table[-1, 0] - table[:, 0], table[:, 1:10].reshape(-1, 3, 3)
    moved = np.linalg.norm(tips - tips[0], axis=2).mean(axis=1)
    return float(moved[left < 1].mean() / moved[(left >= 3) & (left < 4)].mean() - 1)


def predicted_drop(branch: Path, name: str, load: float) -> float:
    """Mean drop of the tip markers [m] that the branch folder's estimate predicts for a load."""
    found = predict(branch, PredictSettings(pull=name, weight=load))
    return float(np.mean(np.array(found["drops_m"])[TIPS]))


def simulated_recording(path: Path, young: float, load: float, seed: int) -> float:
    """Write a recording like the given one, of a beam of known modulus; return its true drop [m].

    Markers are up to 1 mm beside their nominal positions, the capture frame is rotated, the beam is
    released after 0.4 s and swings.
    """
    rng = np.random.default_rng(seed)
    mesh = box_mesh((16, 5, 5))
    model = BranchModel(mesh, young=young, poisson=POISSON, density=DENSITY, gravity=GRAVITY)
    state = solve_static(model, grasp=edge_load(mesh), grasp_force=(0.0, 0.0, -load)).require()
    placed = NOMINAL_M + rng.uniform(-1e-3, 1e-3, NOMINAL_M.shape) / np.sqrt(3)
    moved = (point_operator(mesh, placed) @ state.displacement.ravel()).reshape(-1, 3)
    times = np.arange(600) / 100.0
    since = np.maximum(times - 0.4, 0.0)
    part = np.where(times > 0.4, 1 - np.exp(-2.2 * since) * np.cos(18 * since), 0.0)
    turn = Rotation.from_rotvec(rng.uniform(-2, 2, 3)).as_matrix()
    seen = (placed + part[:, None, None] * moved) @ turn.T + rng.uniform(-1, 1, 3)
    seen = seen + 5e-6 * rng.standard_normal(seen.shape)
    write_stream(path, Stream(times, seen.reshape(len(times), -1), tuple(
        f"{label}_{axis}_m" for label in LABELS for axis in "xyz")))
    return -float(moved[TIPS, 2].mean())


def box_mesh(cells: tuple[int, int, int] = (12, 4, 4)) -> TetMesh:
    """Quadratic tetrahedra of the beam: bricks cut into six; the clamped face is marked."""
    axes = [np.linspace(low, low + size, count + 1) for low, size, count in
            zip((-SIZE_M[0], 0.0, 0.0), SIZE_M, cells, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape([count + 1 for count in cells])
    corner = [number[i:cells[0] + i, j:cells[1] + j, k:cells[2] + k].ravel()
              for i, j, k in np.ndindex(2, 2, 2)]
    # Kuhn's subdivision: along the diagonal from corner 000 to 111, the same in every brick.
    paths = [(0, 4, 6, 7), (0, 4, 5, 7), (0, 2, 6, 7), (0, 2, 3, 7), (0, 1, 5, 7), (0, 1, 3, 7)]
    tets = np.concatenate([np.column_stack([corner[c] for c in path]) for path in paths])
    mesh = TetMesh(nodes, tets).oriented().quadratic()
    clamped = np.abs(mesh.nodes[:, 0] + SIZE_M[0]) < 1e-9
    return mesh.with_data(point_data={"fixed": clamped.astype(np.int64)})


def edge_load(mesh: TetMesh) -> Grasp:
    """The top edge of the free face, with the weights of an even line load."""
    on_edge = np.flatnonzero((np.abs(mesh.nodes[:, 0]) < 1e-9)
                             & (np.abs(mesh.nodes[:, 2] - SIZE_M[2]) < 1e-9))
    along = np.argsort(mesh.nodes[on_edge, 1])
    # Simpson's rule on each edge of three nodes.
    weights = np.zeros(len(on_edge))
    for start in range(0, len(on_edge) - 2, 2):
        weights[along[start:start + 3]] += np.array([1, 4, 1]) / 6
    weights /= weights.sum()
    return Grasp(on_edge, weights, weights @ mesh.nodes[on_edge], "point")


def drop(young: float, load: float, *, poisson: float = POISSON,
         cells: tuple[int, int, int] = (12, 4, 4)) -> float:
    """Static drop of the tip markers [m] under a load [N], on bricks of ``cells`` cut into six."""
    mesh = box_mesh(cells)
    model = BranchModel(mesh, young=young, poisson=poisson, density=DENSITY, gravity=GRAVITY)
    state = solve_static(model, grasp=edge_load(mesh), grasp_force=(0.0, 0.0, -load)).require()
    operator = point_operator(mesh, NOMINAL_M[:3])
    return -float((operator @ state.displacement.ravel()).reshape(-1, 3)[:, 2].mean())
