"""The target in a region that a robot's cell gives: ``--in-view``, ``--second-arm``.

The region is an outer bound: within it the arm may not reach every position, and the branch may
hide the target. Which grasp poses are valid is tested at poses of the field (for an arm, whose
kinematics depend on the target's position alone) or of the branch model (for a view, past the
branch's own surface), and by bisection between the two kinds. Elsewhere a pose counts as valid if
it is nearer to a valid one than to an invalid one. Each planned path adds its own states, so that
the border is refined where paths end.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from limber.core.errors import InputError, NoPathError
from limber.planning.field.energy_field import EnergyField
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.interpolation.valid_region import nearest_of
from limber.planning.field.sampling import solve_branch
from limber.planning.field.solver_pool import SolverPool
from limber.planning.goals.goal import CellPlace, GoalKind, GoalRequest
from limber.planning.goals.target_goal import TargetGoal, target_of
from limber.planning.path_on_full_model import SolvedPoses

_DRAWN = 2000  # poses of the field searched for those in the region
_ASKED = 150  # most of these, where only the target's position counts
_PAIRS, _HALVINGS = 40, 5  # pairs between which the border is searched; halvings
_SOLVED = 16  # most states of the branch model, where its surface counts as well
_SOLVED_PAIRS, _SOLVED_HALVINGS = 4, 3  # the same with states of the branch model
_NOWHERE = np.empty((0, 3))


@dataclass(frozen=True, kw_only=True)
class CellGoal(TargetGoal):
    """A target in a region of the cell, at a valid position.

    Attributes:
        cell_place: The region and its test.
        grasp_model: Model of the branch.
        taken, refused: Positions of the grasp at which the target's position is valid, and at which
            it is in the region and is not valid [m], shapes [k, 3] and [q, 3].
        causes: Why the refused ones are not valid, clauses [q].
    """

    cell_place: CellPlace
    grasp_model: GraspModel
    taken: np.ndarray = field(default_factory=_NOWHERE.copy)
    refused: np.ndarray = field(default_factory=_NOWHERE.copy)
    causes: tuple[str, ...] = ()

    @property
    def where(self) -> str:
        return f"within {self.cell_place.words}"

    def distance(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        within = super().distance(field, points)
        if not len(self.refused) or not len(self.taken):
            return within
        points = np.ascontiguousarray(points, float).reshape(-1, 3)
        nearer = nearest_of(points, self.taken)[0] - nearest_of(points, self.refused)[0]
        return np.maximum(within, self.tolerance + 0.5 * nearer)

    def uncertainty(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        # Between invalid poses there may be a valid one: then nothing is proven.
        if len(self.refused):
            return np.full(len(points), np.inf)
        return super().uncertainty(field, points)

    def drawn_in(self, states: SolvedPoses) -> Self:
        positions = states.tips if self.target is None else states.targets[:, self.target]
        return super().drawn_in(states)._asked(states.poses[:, :3], positions, states.displacements)

    def require_end(self, grasp_model: GraspModel, states: SolvedPoses) -> None:
        self.cell_place.require(self.what, self.target_position(states),
                                self._surface(states.displacements[-1]))

    def learnt(self, field: EnergyField) -> Self:
        """Return the goal with the results at poses of the field.

        Raises:
            NoPathError: the target is in the region at some of them, and valid at none.
        """
        if self.cell_place.of_surface:
            with SolverPool(self.grasp_model, 1) as solvers:
                found = self._of_states(field, solvers)
        else:
            points = np.concatenate([field.rest[None], field.region.draw(
                _DRAWN, np.random.default_rng(0))])
            points = points[TargetGoal.distance(self, field, points) <= self.tolerance][:_ASKED]
            found = self._asked(points, field.tip(points, self.target), None)._sharpened(
                lambda middle: [self._cause(one, None) for one in field.tip(middle, self.target)],
                _PAIRS, _HALVINGS)
        if len(found.refused) and not len(found.taken):
            raise found.refusal()
        return found

    def _sharpened(self, causes_at: Callable[[np.ndarray], list[str]], pairs: int, halvings: int,
                   ) -> Self:
        """Return the goal with poses near its border: between invalid ones and the nearest valid
        ones; ``causes_at`` gives why each of some poses [n, 3] is not valid.
        """
        if not len(self.taken) or not len(self.refused):
            return self
        chosen = _far_apart(self.refused, pairs)
        wrong, causes = self.refused[chosen], [self.causes[k] for k in chosen]
        distance = np.linalg.norm(wrong[:, None] - self.taken[None], axis=2)
        right = self.taken[distance.argmin(axis=1)]
        for _ in range(halvings):
            middle = 0.5 * (wrong + right)
            found = causes_at(middle)
            does = np.array([not cause for cause in found])[:, None]
            wrong, right = np.where(does, wrong, middle), np.where(does, middle, right)
            causes = [new or old for new, old in zip(found, causes, strict=True)]
        return replace(self, taken=np.concatenate([self.taken, right]),
                       refused=np.concatenate([self.refused, wrong]),
                       causes=(*self.causes, *causes))

    def _of_states(self, field: EnergyField, solvers: SolverPool) -> Self:
        """Test states of the branch model at samples of the field in the region, far apart, and
        between them.
        """
        samples = field.samples
        positions = samples.tips if self.target is None or samples.targets is None else (
            samples.targets[:, self.target])
        inside = np.flatnonzero(self.region.distance(positions) <= 0.0)
        if not len(inside):
            return self
        chosen = inside[_far_apart(samples.positions[inside], _SOLVED)]
        states = solve_branch(solvers, samples.positions[chosen])[0][1:]
        which = [chosen[one.target] for one in states]
        found = self._asked(samples.positions[which], positions[which],
                            np.array([one.displacement for one in states]))

        def causes_at(middle: np.ndarray) -> list[str]:
            causes = ["the branch has no equilibrium there"] * len(middle)
            for one in solve_branch(solvers, middle, states)[0][1 + len(states):]:
                place = one.tip if self.target is None else one.targets[self.target]
                causes[one.target] = self._cause(place, one.displacement)
            return causes
        return found._sharpened(causes_at, _SOLVED_PAIRS, _SOLVED_HALVINGS)

    def _asked(self, grasps: np.ndarray, positions: np.ndarray, moved: np.ndarray | None) -> Self:
        """Return the goal with poses [n, 3] added that have the target at ``positions`` [n, 3]; the
        nodes are displaced by ``moved`` [n, nodes, 3] there.
        """
        inside = np.flatnonzero(self.region.distance(positions) <= 0.0)
        causes = [self._cause(positions[k], None if moved is None else moved[k]) for k in inside]
        does = np.array([not cause for cause in causes], bool)
        return replace(self, taken=np.concatenate([self.taken, grasps[inside[does]]]),
                       refused=np.concatenate([self.refused, grasps[inside[~does]]]),
                       causes=(*self.causes, *filter(None, causes)))

    def _cause(self, position: np.ndarray, moved: np.ndarray | None) -> str:
        """Return why a position is not valid, with the nodes displaced by ``moved`` [n, 3]; empty
        if it is.
        """
        if self.region.distance(position[None])[0] > 0.0:
            return "it lies outside"
        surface = None
        if self.cell_place.of_surface and moved is not None:
            surface = self._surface(moved)
        return self.cell_place.blocked(position, surface)

    def _surface(self, moved: np.ndarray) -> np.ndarray:
        """Return the surface's triangles [f, 3, 3] with nodes displaced by ``moved`` [n, 3]."""
        mesh = self.grasp_model.mesh
        return (mesh.nodes + moved)[mesh.surface_faces()]

    def refusal(self) -> NoPathError:
        """Return the error of a goal that no pose reached, with the causes."""
        count, causes = len(self.refused), Counter(self.causes).most_common()
        counted = (f"{causes[0][0]} at each" if len(causes) == 1 else
                   ", ".join(f"{cause} at {number}" for cause, number in causes))
        return NoPathError(
            f"{self.cell_place.refusal.format(what=self.what)} at any of the {count} poses that "
            f"were checked: {counted}.",
            f"At these poses {self.what} lies {self.where}.",
            f"{self.advice}, or sample farther (`limber energy --deflection`).")


def _far_apart(points: np.ndarray, count: int) -> np.ndarray:
    """Return numbers of at most ``count`` of ``points`` [n, 3], each far from those before."""
    chosen = [0]
    away = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)) and away.max() > 0.0:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def _kind(name: str, entry: str) -> GoalKind:
    def made(asked: GoalRequest, _value: bool) -> CellGoal:
        if name not in asked.cell:
            raise InputError(f"--{name.replace('_', '-')} is given without a cell that has a "
                             f"{entry}.",
                             "The cell file states its position.",
                             "Give --cell with such a file.")
        place = asked.cell[name]
        return CellGoal(place.region, *target_of(asked), advice=place.advice, cell_place=place,
                        grasp_model=asked.grasp_model).learnt(asked.field)
    return GoalKind(name, made, is_of_target=True)


IN_VIEW = _kind("in_view", "[camera] at a fixed position")
SECOND_ARM = _kind("second_arm", "[second_arm]")
