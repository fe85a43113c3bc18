"""Our own tetrahedra for forked branches, swept along the axes: deterministic and quick."""

from limber.geometry.cylinder_mesh import sweep_run
from limber.geometry.skeleton import Skeleton
from limber.geometry.sweep import resample
from limber.geometry.tet_mesh import TetMesh


def sweep_tree(skeleton: Skeleton, *, sides: int = 6, spacing: float = 4.0) -> TetMesh:
    """Return linear tetrahedra of the main run."""
    main = skeleton.runs()[0]
    radius = skeleton.radius[main]
    centres, radii = resample(skeleton.nodes[main], radius, spacing * radius)
    return sweep_run(centres, radii, sides=sides)
