"""The recorded silicone beam: Young's modulus from how far a hung weight bends it.

Frame 0 of the recording is the straight beam, held up; then both its own weight and the hung one
act. The recording's marker coordinates are fitted rigidly onto the nominal ones at frame 0.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from limber.estimation.alignment import Frames
from limber.estimation.estimate import fit_pulls
from limber.estimation.objective import Objective
from limber.estimation.parameters import ParameterSpace, Values
from limber.estimation.quasi_static import QuasiStaticForward
from limber.estimation.recording import GraspEntry, PullEntry, SensorEntry
from limber.estimation.registration import rigid_fit
from limber.estimation.settings import EstimateSettings
from limber.estimation.streams import read_stream
from limber.geometry.tet_mesh import TetMesh
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel

RECORDING = Path(__file__).parents[4] / "shared/data/silicone_beam/beam_load52_V2_a.csv"
SIZE_M = (0.1, 0.03, 0.03)
DENSITY, POISSON = 1070.0, 0.49
GRAVITY = (0.0, 0.0, -9.80709)
LOAD_N = 0.51012
NOMINAL_M = np.array([[0, .015, .036], [0, -.006, .024], [0, .036, .006],
                      [-.094, -.01, -.001], [-.094, .04, .0275], [-.094, .04, 0]])


@dataclass(frozen=True)
class BeamResult:
    """What the recording gives.

    Attributes:
        young: [Pa].
        interval: 95 % [Pa].
        measured_drop, simulated_drop: Mean of the tip markers, downwards [m].
    """

    young: float
    interval: tuple[float, float]
    measured_drop: float
    simulated_drop: float


def box_mesh(cells: tuple[int, int, int] = (12, 4, 4)) -> TetMesh:
    """Quadratic tetrahedra of the beam: bricks cut in six; the clamped face is marked."""
    axes = [np.linspace(low, low + size, count + 1) for low, size, count in
            zip((-SIZE_M[0], 0.0, 0.0), SIZE_M, cells, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape([count + 1 for count in cells])
    corner = [number[i:cells[0] + i, j:cells[1] + j, k:cells[2] + k].ravel()
              for i, j, k in np.ndindex(2, 2, 2)]
    # Kuhn's subdivision: along the diagonal from corner 000 to 111, alike in every brick.
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
    return Grasp(on_edge, weights, weights @ mesh.nodes[on_edge], "pinned")


def tip_markers(path: Path = RECORDING) -> tuple[np.ndarray, np.ndarray]:
    """Tip markers in the beam's frame [m]: at rest, shape [3, 3], and over time [n, 3, 3]."""
    stream = read_stream(path)
    positions = stream.values.reshape(len(stream), 6, 3)
    turn, shift = rigid_fit(positions[0], NOMINAL_M)
    moved = positions @ turn.T + shift
    return moved[0, :3], moved[:, :3]


def estimate_beam(load: float = LOAD_N, *, poisson: float = POISSON,
                  cells: tuple[int, int, int] = (12, 4, 4), path: Path = RECORDING) -> BeamResult:
    """Estimate E from the settled part of the recording (its last second)."""
    rest, track = tip_markers(path)
    # The rigid fit of frame 0 leaves 0.3 to 2 mm a marker: that, not the camera's noise, is how
    # well the markers' places are known. Displacements since frame 0 are far better.
    settled = track[-100:].mean(axis=0)[None].repeat(2, axis=0)
    mesh = box_mesh(cells)
    model = BranchModel(mesh, young=2e5, poisson=poisson, density=DENSITY, gravity=GRAVITY)
    entry = PullEntry(drive="force", gravity_m_s2=GRAVITY, sensor=SensorEntry(),
                      grasp=GraspEntry(point_m=(0.0, 0.015, 0.03), radius_m=0.01, mode="pinned"))
    force = np.full((2, 6), np.nan)
    force[:, :3] = (0.0, 0.0, -load)
    frames = Frames(np.array([0.0, 1.0]), np.zeros((2, 6)), force, np.ones(2, int), settled,
                    np.broadcast_to(2 * (4e-4)**2 * np.eye(3), (2, 3, 3, 3)))
    forward = QuasiStaticForward("beam", model, np.ones((mesh.tet_count, 1)), entry, frames, rest)
    forward.grasp = edge_load(mesh)
    start = Values(np.array([2e5]), poisson, DENSITY)
    objective = Objective([forward], ParameterSpace.separate(start))
    found = fit_pulls(objective, start, EstimateSettings(hold_out=False), lambda _message: None)
    simulated = found.fit.evaluation.pulls[0].positions[0]
    low, high = found.uncertainty.young_interval[0]
    return BeamResult(float(found.values.young[0]), (float(low), float(high)),
                      float(np.mean(rest[:, 2] - settled[0, :, 2])),
                      float(np.mean(rest[:, 2] - simulated[:, 2])))


def drop(young: float, load: float, *, poisson: float = POISSON,
         cells: tuple[int, int, int] = (12, 4, 4)) -> float:
    """Static drop of the tip markers [m] under another load [N]: what other recordings show."""
    from limber.estimation.points import point_operator
    from limber.mechanics.statics import solve_static

    mesh = box_mesh(cells)
    model = BranchModel(mesh, young=young, poisson=poisson, density=DENSITY, gravity=GRAVITY)
    state = solve_static(model, grasp=edge_load(mesh), grasp_force=(0.0, 0.0, -load)).require()
    operator = point_operator(mesh, NOMINAL_M[:3])
    return -float((operator @ state.displacement.ravel()).reshape(-1, 3)[:, 2].mean())
