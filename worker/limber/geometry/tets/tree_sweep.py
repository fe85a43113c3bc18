"""Our own tetrahedra for forked branches, swept along the axes: deterministic and fast.

Each run is a stack of prisms around its axis. They have six sides, or four for a thin twig, and the
second moment of area of the round section, so that they bend like it. A twig grows out of its
carrier's side: the carrier has a slice there as long as the twig is thick, and one or two of that
slice's side faces are the twig's first cross-section. The block between them and the twig's first
ring is a fan of tetrahedra around that ring's centre.
"""

from dataclasses import dataclass, field

import numpy as np

from limber.core.errors import MeshingError
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.fork_joints import Patch, joints
from limber.geometry.tets.quality import FLAT, shapes
from limber.geometry.tets.run_axis import RunAxis
from limber.geometry.tets.slices import Window, without_overlap
from limber.geometry.tets.tet_mesh import TetMesh
from limber.geometry.tets.unfolded_tube import unfolded

_STARTS, _LEANS = 60, (0.3, 0.8, 1.6)  # positions tried for a twig's first ring; its lean
_NEAR = 2.5  # radii beyond the first possible position within which the best one is used
_STRAIGHTENED = (0.0, 3.0, 6.0, 12.0)  # radii of a twig's start that may be straightened
_OTHERS = 4  # slices nearest to a twig's foot, tried where its own has no room
_THICK_TWIG = 0.5  # fraction of its carrier; such a twig uses two side faces and has six sides


@dataclass(frozen=True)
class SweptTree:
    """A swept mesh.

    Attributes:
        mesh: Linear, positively oriented.
        left_out: Runs of the skeleton that could not be joined to the mesh.
    """

    mesh: TetMesh
    left_out: list[int] = field(default_factory=list)


def sweep_tree(skeleton: Skeleton, *, spacing: float = 2.5) -> SweptTree:
    """Sweep prisms along each run of a skeleton and join them at the forks.

    Args:
        skeleton: Axes and radii.
        spacing: Length of a slice in local radii.

    Raises:
        MeshingError: the main run cannot be swept because its bend is too sharp for its thickness.
    """
    sweep = _TreeSweep(skeleton, spacing)
    for run in range(skeleton.branch_count):
        sweep.add_run(run)
    return sweep.result()


@dataclass
class _Swept:
    axis: RunAxis
    where: np.ndarray
    node: np.ndarray  # first node index of each ring: the centre, then its corners
    sides: int
    windows: dict[int, int]  # slice by run of the twig
    taken: set[tuple[int, int]] = field(default_factory=set)


class _TreeSweep:
    def __init__(self, skeleton: Skeleton, spacing: float):
        self._skeleton = skeleton
        self._spacing = spacing
        self._axes = [RunAxis.of(skeleton, run) for run in range(skeleton.branch_count)]
        starts = [members[0] for members in skeleton.runs()]
        self._carrier = [-1] + [int(skeleton.branch[start]) for start in starts[1:]]
        self._nodes = np.empty((0, 3))
        self._tets = np.empty((0, 4), np.int64)
        self._swept: dict[int, _Swept] = {}
        self._left_out: list[int] = []

    def result(self) -> SweptTree:
        return SweptTree(TetMesh(self._nodes, self._tets), self._left_out)

    def add_run(self, run: int) -> None:
        if run == 0:
            self._sweep(run, 0.0, 6, None)
            return
        carrier, axis = self._swept.get(self._carrier[run]), self._axes[run]
        if carrier is None:
            self._left_out.append(run)
            return
        for at in self._slices(carrier, run):
            for reach in _STRAIGHTENED:
                # A twig that starts along its carrier's side, or in a hook, leaves it on a straight
                # line instead.
                self._axes[run] = axis.straight_until(reach * float(axis.radius[0]))
                for patch in self._patches(carrier, run, at):
                    if self._grow(carrier, run, patch):
                        carrier.taken |= {(patch.slice, side) for side in patch.faces}
                        return
        self._axes[run] = axis
        self._left_out.append(run)

    def _slices(self, carrier: _Swept, run: int) -> list[int]:
        """Slices of the carrier that a twig may grow out of: its own, then those near it."""
        window = Window.of(carrier.axis, self._axes[run], run)
        if window is None:
            return []
        middle = (carrier.where[1:] + carrier.where[:-1]) / 2
        away = np.abs(middle - (window.low + window.high) / 2)
        near = [int(at) for at in np.argsort(away, kind="stable")[:_OTHERS]]
        own = [carrier.windows[run]] if run in carrier.windows else []
        return own + [at for at in near if at not in own]

    def _sweep(self, run: int, start: float, sides: int, first_normal: np.ndarray | None,
               first_tangent: np.ndarray | None = None) -> bool:
        axis = self._axes[run]
        twigs = [twig for twig in range(1, len(self._axes)) if self._carrier[twig] == run]
        windows = without_overlap(filter(None, (
            Window.of(axis, self._axes[twig], twig) for twig in twigs)), axis, start)
        first = len(self._nodes)
        where, mesh = unfolded(axis, start, windows, sides, self._spacing, first_normal,
                               first_tangent)
        if shapes(mesh.nodes[mesh.tets]).min() < 0.1 * FLAT:
            if run == 0:
                raise MeshingError("The main axis bends too sharply for its thickness.",
                                   "Prisms swept along it would overlap.",
                                   "Smooth the skeleton, or choose --mesher ftetwild.")
            return False
        slices = {w.run: int(np.argmin(np.abs(where - w.low))) for w in windows
                  if np.abs(where - w.low).min() < 1e-9}
        self._nodes = np.vstack([self._nodes, mesh.nodes])
        self._tets = np.vstack([self._tets, mesh.tets + first])
        self._swept[run] = _Swept(axis, where, first + np.arange(len(where)) * (sides + 1), sides,
                                  slices)
        return True

    def _patches(self, carrier: _Swept, run: int, at: int) -> list[Patch]:
        """Side faces of the carrier's slice that the twig may start from, best first."""
        low, high = carrier.node[at], carrier.node[at + 1]
        sides = carrier.sides
        radius = float(self._axes[run].radius[1 if len(self._axes[run].radius) > 1 else 0])
        thick = sides == 6 and radius > _THICK_TWIG * float(
            carrier.axis.radius_at(carrier.where[at]))
        nodes = self._nodes
        middle = (nodes[low] + nodes[high]) / 2
        window = Window.of(carrier.axis, self._axes[run], run)
        if window is None:
            return []
        found = []
        for wide in ((2, 1) if thick else (1,)):
            for side in range(sides):
                faces = [(side + k) % sides for k in range(wide)]
                if any((at, face) in carrier.taken for face in faces):
                    continue
                corners = [1 + (side + k) % sides for k in range(wide + 1)]
                loop = [low + c for c in corners] + [high + c for c in reversed(corners)]
                direction = nodes[loop].mean(axis=0) - middle
                direction /= np.linalg.norm(direction)
                found.append((wide, float(direction @ window.outward),
                              Patch(at, faces, np.array(loop), direction)))
        found = [f for f in found if f[1] > -0.2]
        found.sort(key=lambda f: (-f[0], -f[1]))
        return [patch for _, _, patch in found]

    def _grow(self, carrier: _Swept, run: int, patch: Patch) -> bool:
        """Join the twig to the patch: find the best first ring clear of it, sweep, fill between."""
        axis = self._axes[run]
        corner = self._nodes[patch.loop]
        _, foot = axis.nearest(corner.mean(axis=0)[None])
        start, lean = np.meshgrid(np.linspace(foot[0], 0.75 * axis.length, _STARTS), _LEANS,
                                  indexing="ij")
        found = joints(axis, start.ravel(), lean.ravel(), patch, corner,
                       self._patch_triangles(patch))
        # The best one near the patch; those farther out are for twigs that leave at a small angle.
        near = [joint for joint in found if joint.start <= found[0].start + _NEAR * float(
            axis.radius_at(joint.start))]
        for joint in sorted(near, key=lambda one: -one.quality):
            first = len(self._nodes)
            if self._sweep(run, joint.start, len(patch.loop), joint.turn, joint.tangent):
                block = np.where(joint.tets >= 0, joint.tets, first - 1 - joint.tets)
                self._tets = np.vstack([self._tets, block])
                return True
        return False

    def _patch_triangles(self, patch: Patch) -> np.ndarray:
        """The carrier's boundary triangles on the patch, outward, shape [2 or 4, 3]."""
        inside = np.zeros(len(self._nodes), bool)
        inside[patch.loop] = True
        # Both tetrahedra at a face have three corners in the loop if the face has.
        near = self._tets[inside[self._tets].sum(axis=1) > 2]
        faces = TetMesh(np.empty((0, 3)), near).surface_faces()
        return faces[inside[faces].all(axis=1)]
