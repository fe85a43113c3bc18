"""The six branches of the planning bench: the paper's three arcs and three forked ones."""

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.paper_branches import BRANCHES, FRACTIONS, PaperBranch
from limber.core.progress import SILENT, Progress
from limber.geometry.generated import generate_branch
from limber.geometry.settings import GRASP_FRACTION
from limber.geometry.skeleton.skeleton import Skeleton, control_points
from limber.geometry.tets.tet_mesh import TetMesh, mark
from limber.geometry.tets.tetrahedra import mesh_branch
from limber.mechanics import BranchModel, young_weights
from limber.mechanics.loads.loaded_branch import hang
from limber.planning.field.grasp_model import GraspModel, grasp_model_of

ARC_NAMES = tuple(branch.name for branch in BRANCHES)
_GRAVITY = (0.0, 0.0, -9.80665)
_DENSITY = 900.0


@dataclass(frozen=True)
class Subject:
    """A branch to plan on; ``shares`` [tets, K] of each control point in a tetrahedron's E."""

    name: str
    model: GraspModel
    shares: np.ndarray


def arcs() -> list[Subject]:
    """Return the paper's branches with its moduli, too soft to bear their own weight."""
    return [_arc(branch) for branch in BRANCHES]


def forked(seed: int, count: int, progress: Progress = SILENT) -> list[Subject]:
    """Return ``count`` drawn branches of wood, 0.4 to 0.7 m long with one to three twigs."""
    found = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        length = rng.uniform(0.4, 0.7)
        root = rng.uniform(0.010, 0.013) * length
        drawn = generate_branch(
            int(rng.integers(1 << 31)), length=length, radius_root=root, bend=rng.uniform(0.2, 0.7),
            radius_tip=rng.uniform(0.45, 0.7) * root, fork_count=int(rng.integers(1, 4)),
            young_mean=10 ** rng.uniform(8.5, 9.5))
        mesh = mesh_branch(drawn.skeleton).mesh
        found.append(_subject(f"forked {number + 1}", mesh, drawn.skeleton, drawn.young, 0.35,
                              _GRAVITY, progress))
    return found


def _arc(branch: PaperBranch) -> Subject:
    skeleton = branch.skeleton
    return _subject(branch.name, branch.mesh(slice_length=2.0, sides=6), skeleton,
                    np.array(branch.young), branch.poisson, None)


def _subject(name: str, mesh: TetMesh, skeleton: Skeleton, young: np.ndarray, poisson: float,
             gravity: tuple[float, float, float] | None, progress: Progress = SILENT) -> Subject:
    mesh = mark(mesh, skeleton, young=1.0, poisson=poisson, density=_DENSITY)
    parts = young_weights(mesh, control_points(skeleton, FRACTIONS)) * young
    values = parts.sum(axis=1)
    mesh = mesh.with_data(cell_data={"young": values})
    model = BranchModel(mesh, young=values, poisson=poisson, density=_DENSITY, gravity=gravity)
    loaded = replace(hang(model, progress=progress),
                     grasp_point=tuple(map(float, skeleton.point_at(GRASP_FRACTION))))
    return Subject(name, grasp_model_of(loaded, skeleton), parts / values[:, None])
