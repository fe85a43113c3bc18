"""The branch as a rod from its base to the grasp: its equilibria take a millisecond.

Its sections' stiffness is the mesh's own. Under six unit loads at the grasp, three forces and three
moments, the strain energy of the tetrahedra of each piece of the path is that of a rod's element
under the wrenches W there, so its compliance is C = W^-T U W^-1 for the energies U [6, 6]. These
sum to the compliance of the whole mesh at the grasp: rod and mesh agree to first order. Twigs, and
what lies beyond the grasp, are carried rigidly with their weight. A state's strains are those of
the six loads, mixed by the stress of each element: full solves start from them.

On four branches its energy is off by 0.1 to 0.3 % in the median, the tip by 0.2 mm; both are smooth
over the grasp's positions. The full model solves each from there
(:mod:`limber.planning.field.sampling`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.skeleton.skeleton import Skeleton
from limber.mechanics import BranchModel, Grasp
from limber.mechanics.elements.shape_functions import stiffness_quadrature
from limber.mechanics.materials.laws import MULTIPLICITY, hooke_stress
from limber.planning.field.rod_kernels import known_at, newton

_SECTIONS = 36
_LONGEST = 0.05  # largest step of the grasp, as a fraction of the rod's length
_JUMPED = 0.02  # 1 - cosine of half a section's turn in one step, above which it jumped
_FINEST = 1 / 256  # of a step, below which there is a fold
_LOAD_STEPS = 12
_SPACING = 5e-4  # [m] of the points that tell where on the path another point is
_SOFTEST = 1e-6  # least compliance of an element, over that of the median
_FEWEST = 8  # nodes on which a moment acts, if the grasp has fewer


class RodState(NamedTuple):
    """Positions [N + 1, 3] and quaternions [N + 1, 4] of the sections in an equilibrium."""

    places: np.ndarray
    turns: np.ndarray


class Guess(NamedTuple):
    """Guess of a branch's shape: ``displacement`` [m], shape [node_count, 3], and the matching
    ``strain``, [tet_count, q, 6]; None if it is not known better."""

    displacement: np.ndarray
    strain: np.ndarray | None = None


class RodPoints(NamedTuple):
    """Points of the branch: sections of the rod between which they lie, the part of the way to the
    second, and their arms from there [m]."""

    before: np.ndarray
    part: np.ndarray
    arms: np.ndarray


class Rod:
    """The rod of a model up to its grasp, along the main path of the skeleton."""

    def __init__(self, model: BranchModel, grasp: Grasp, skeleton: Skeleton):
        self.model, self.grasp = model, grasp
        path, arc = skeleton.main_path(), skeleton.arc_length
        points, self._along = _placed(skeleton, path)
        self._tree = cKDTree(points)
        end = float(np.clip(self._arc(grasp.centre[None])[0], 0.05 * arc.max(), arc.max()))
        self.along = np.linspace(0.0, end, _SECTIONS + 1)
        self.rest_places = np.column_stack([
            np.interp(self.along, arc[path], axis) for axis in skeleton.nodes[path].T])
        self.rest_places[-1] = grasp.centre
        middles = 0.5 * (self.rest_places[1:] + self.rest_places[:-1])
        self._of_mesh = self.points(model.mesh.nodes)
        wrenches = np.zeros((_SECTIONS, 6, 6))
        wrenches[:] = np.eye(6)
        for axis, unit in enumerate(np.eye(3)):
            wrenches[:, 3:, axis] = np.cross(grasp.centre - middles, unit)
        stiff = self._measured(wrenches)
        loads, arms, carried = self._weight(middles)
        self.arrays = (np.diff(self.rest_places, axis=0), stiff, carried, loads, arms)
        still = np.zeros((_SECTIONS + 1, 4))
        still[:, 0] = 1.0
        unmoved = RodState(self.rest_places.copy(), still)
        self.rest = self.pulled(unmoved, np.zeros(3)) or unmoved

    def points(self, places: np.ndarray) -> RodPoints:
        """Return points of the branch at rest [n, 3] [m]."""
        at = np.clip(self._arc(places), 0.0, self.along[-1]) / self.along[1]
        before = np.minimum(at.astype(int), _SECTIONS - 1)
        part = (at - before)[:, None]
        rest = (1 - part) * self.rest_places[before] + part * self.rest_places[before + 1]
        return RodPoints(before, part, places - rest)

    def followed(self, state: RodState, place: np.ndarray) -> tuple[RodState | None, float]:
        """Take the grasp to a place [3] slowly. Return the state, None if the branch would snap on
        the way, and the fraction of the way up to the fold of its equilibria."""
        begin = state.places[-1]
        way = np.asarray(place, float) - begin
        whole = 1.0 / max(1.0, np.ceil(np.linalg.norm(way) / (_LONGEST * self.along[-1])))

        def held(r: np.ndarray, q: np.ndarray, part: float) -> bool:
            return all(newton(r, q, self.arrays, begin + part * way, True))

        state, reached = _walked(state, held, whole)
        return (state if reached == 1.0 else None), reached

    def pulled(self, state: RodState, force: np.ndarray) -> RodState | None:
        """Return the state under a force [3] [N] on the free grasp, from one that is held, if it
        leads there without a snap."""
        here = self.held(state)[0]

        def loaded(r: np.ndarray, q: np.ndarray, part: float) -> bool:
            return all(newton(r, q, self.arrays, here + part * (force - here), False))

        state, reached = _walked(state, loaded, 1 / _LOAD_STEPS)
        return state if reached == 1.0 else None

    def held(self, state: RodState) -> tuple[np.ndarray, np.ndarray]:
        """Return the force [3] [N] on the grasp that holds a state, and its stiffness [3, 3]
        [N/m]."""
        _, force, _, _, stiff = known_at(*state, self.arrays)
        return force, stiff

    def moved(self, state: RodState, points: RodPoints) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [p, 3] [m] of points, and their change with the grasp's, [3, p, 3]."""
        changes = known_at(*state, self.arrays)[3]
        changes = np.concatenate([np.zeros((1, 6, 3)), changes.reshape(-1, 6, 3)])
        places, arms = self._carried(state, points)
        turn, shift = ((1 - points.part)[:, :, None] * changes[points.before, rows]
                       + points.part[:, :, None] * changes[points.before + 1, rows]
                       for rows in (slice(0, 3), slice(3, 6)))
        return places, (shift - np.cross(arms[:, :, None], turn, axis=1)).transpose(2, 0, 1)

    def lifted(self, state: RodState) -> Guess:
        """Return the mesh's displacement and strain."""
        stress = known_at(*state, self.arrays)[2]
        mix = np.linalg.solve(self._wrenches, stress[:, :, None])[:, :, 0]
        middle = np.arange(_SECTIONS) + 0.5
        mesh = self._of_mesh
        at_nodes, at_points = (np.column_stack([np.interp(at, middle, one) for one in mix.T])
                               for at in (mesh.before + mesh.part[:, 0], self._at_points))
        places, _ = self._carried(state, RodPoints(
            mesh.before, mesh.part,
            mesh.arms + np.einsum("ni,ink->nk", at_nodes, self._warps)))
        moved = np.where(self.model.fixed[:, None], 0.0, places - self.model.mesh.nodes)
        count, points = self.model.weights.shape
        strain = np.einsum("ni,ink->nk", at_points, self._strains)
        return Guess(moved, strain.reshape(count, points, 6))

    def _arc(self, places: np.ndarray) -> np.ndarray:
        return self._along[self._tree.query(places)[1]]

    def _carried(self, state: RodState, points: RodPoints) -> tuple[np.ndarray, np.ndarray]:
        """Return the points' positions and their turned arms, [n, 3] each."""
        part, before = points.part, points.before
        turn = (1 - part) * state.turns[before] + part * state.turns[before + 1]
        turn /= np.linalg.norm(turn, axis=1, keepdims=True)
        w, axis, arms = turn[:, :1], turn[:, 1:], points.arms
        arms = arms + 2 * np.cross(axis, np.cross(axis, arms) + w * arms)
        return ((1 - part) * state.places[before] + part * state.places[before + 1] + arms), arms

    def _measured(self, wrenches: np.ndarray) -> np.ndarray:
        """Return the elements' stiffness [N, 6, 6]; keep strains and warping of the unit loads."""
        model = self.model
        if model.gravity.any():
            model = model.with_parameters(gravity=(0.0, 0.0, 0.0))
        nothing = np.zeros_like(model.mesh.nodes)
        tangent = model.equations().tangent(model, nothing)
        moved = np.array(tangent.solve_all(self._unit_loads()))
        strains = np.array([model.strain_changes(nothing, one) for one in moved])
        stresses = hooke_stress(strains, model.lame_lambda[:, None], model.lame_mu[:, None])
        corners = model.mesh.nodes[model.mesh.tets[:, :4]]
        parts = stiffness_quadrature(model.mesh).points
        places = np.einsum("qa,eai->eqi", parts, corners).reshape(-1, 3)
        at = np.clip(self._arc(places) / self.along[1], 0.0, _SECTIONS - 1e-9)
        self._at_points, self._wrenches = at, wrenches
        self._strains = strains.reshape(6, -1, 6)
        weighed = (stresses * MULTIPLICITY * model.weights[..., None]).reshape(6, -1, 6)
        energies = np.array([np.einsum("ink,jnk->ij", weighed[:, own], self._strains[:, own])
                             for own in (at.astype(int) == k for k in range(_SECTIONS))])
        inverse = np.linalg.inv(wrenches)
        compliance = np.einsum("kji,kjl,klm->kim", inverse, energies, inverse)
        self._warps = self._beside(moved, np.einsum("kij,kjl->kil", compliance, wrenches))
        # Moments by a length, so that all entries have one unit.
        unit = np.repeat([1.0, self.along[1]], 3)
        both = unit[:, None] * unit
        values, axes = np.linalg.eigh(compliance * both)
        values = np.maximum(values, _SOFTEST * np.median(values[:, -1]))
        return np.ascontiguousarray(np.einsum("kia,ka,kja->kij", axes, 1 / values, axes) * both)

    def _unit_loads(self) -> list[np.ndarray]:
        nodes, weights = self.grasp.nodes, self.grasp.weights
        centre, rest = self.grasp.centre, self.model.mesh.nodes
        about, even = nodes, weights
        if len(nodes) < _FEWEST:
            about = np.argsort(np.linalg.norm(rest - centre, axis=1), kind="stable")[:_FEWEST]
            even = np.full(_FEWEST, 1 / _FEWEST)
        middle = even @ rest[about]
        arms = rest[about] - middle
        squares = np.einsum("k,ki,kj->ij", even, arms, arms)
        spread = np.linalg.pinv(np.trace(squares) * np.eye(3) - squares, rcond=1e-9)
        loads = []
        for unit in np.eye(3):
            loads.append(np.zeros_like(rest))
            loads[-1][nodes] = weights[:, None] * unit
        for unit in np.eye(3):
            loads.append(np.zeros_like(rest))
            loads[-1][about] = even[:, None] * np.cross(spread @ unit, arms)
        return loads

    def _beside(self, moved: np.ndarray, strains: np.ndarray) -> np.ndarray:
        """Return the displacements [6, n, 3] of the unit loads beside the sections' own, from the
        elements' ``strains`` [N, 6, 6] under them."""
        steps = np.diff(self.rest_places, axis=0)
        turn, shift = np.zeros((_SECTIONS + 1, 3, 6)), np.zeros((_SECTIONS + 1, 3, 6))
        for k in range(_SECTIONS):
            turn[k + 1] = turn[k] + strains[k, 3:]
            middle = 0.5 * (turn[k] + turn[k + 1])
            shift[k + 1] = shift[k] + strains[k, :3] + np.cross(
                middle, steps[k][:, None], axis=0)
        mesh = self._of_mesh
        turns, shifts = ((1 - mesh.part[:, :, None]) * one[mesh.before]
                         + mesh.part[:, :, None] * one[mesh.before + 1] for one in (turn, shift))
        own = shifts + np.cross(turns, mesh.arms[:, :, None], axis=1)
        return moved - own.transpose(2, 0, 1)

    def _weight(self, middles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the sections' weights [N + 1, 3] [N] and arms [m], and the wrench in each element
        [N, 6] that carries the weight in the scanned shape."""
        model, mesh = self.model, self._of_mesh
        loads, arms = np.zeros((_SECTIONS + 1, 3)), np.zeros((_SECTIONS + 1, 3))
        carried = np.zeros((_SECTIONS, 6))
        if not model.gravity.any():
            return loads, arms, carried
        all_loads = model.mass_load[:, None] * model.gravity
        own = all_loads - model.weight_force
        nodes, sections = model.mesh.nodes, np.rint(mesh.before + mesh.part[:, 0]).astype(int)
        for k in range(_SECTIONS + 1):
            mass = model.mass_load[sections == k]
            if mass.sum() > 0.0:
                loads[k] = mass.sum() * model.gravity
                arms[k] = mass @ nodes[sections == k] / mass.sum() - self.rest_places[k]
        for k, middle in enumerate(middles):
            beyond = own[sections > k]
            carried[k] = np.concatenate([beyond.sum(axis=0), np.cross(
                nodes[sections > k] - middle, beyond).sum(axis=0)])
        return loads, arms, carried


def _walked(state: RodState, solve: Callable[[np.ndarray, np.ndarray, float], bool],
            longest: float) -> tuple[RodState, float]:
    """Go along a path in steps that a jump or an unstable state halves; return the last state and
    its fraction, 1 if there is no fold."""
    reached, step = 0.0, longest
    while reached < 1.0 and step > _FINEST * longest:
        part = 1.0 if reached + step > 1 - 1e-9 else reached + step
        r, q = state.places.copy(), state.turns.copy()
        if solve(r, q, part) and (
                np.abs((q * state.turns).sum(axis=1)).min() > 1 - _JUMPED):
            state, reached, step = RodState(r, q), part, min(2 * step, longest)
        else:
            step *= 0.5
    return state, reached


def _placed(skeleton: Skeleton, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points along all axes [m, 3], and where on the main path each is carried [m]: a twig's where
    it forks off."""
    arc, on_path = skeleton.arc_length, np.isin(np.arange(skeleton.node_count), path)
    root = np.arange(skeleton.node_count)
    points: list[Any] = [skeleton.nodes[:1]]
    along: list[Any] = [arc[:1]]
    for node in range(1, skeleton.node_count):
        before = skeleton.parent[node]
        if not on_path[node]:
            root[node] = root[before]
        way = skeleton.nodes[node] - skeleton.nodes[before]
        part = np.linspace(0.0, 1.0, 2 + int(np.linalg.norm(way) / _SPACING))[1:]
        points.append(skeleton.nodes[before] + part[:, None] * way)
        along.append(arc[before] + part * (arc[node] - arc[before]) if on_path[node]
                     else np.full(len(part), arc[root[node]]))
    return np.concatenate(points), np.concatenate(along)
