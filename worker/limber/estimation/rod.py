"""A rod that is pulled: the truth of virtual pulls that shares no code with the fit's simulation.

The main path up to the grasp is a Cosserat rod (Antman, Nonlinear Problems of Elasticity, 2005,
ch. 8) of round sections that bends, twists, stretches and shears. Side branches, and the part
beyond the grasp, are rigid bodies on it. With the position r, the rotation R of a section from its
scanned position, and the force n and moment m that the outer part exerts on it,

    r' = R (t + C (R^T n - n0)),    R' = R hat(K (R^T m - m0)),    m' = -r' x n - (R d) x g,

where n is the gripper's force plus the weight farther out; t is the scanned axis' derivative, C and
K are the section's compliances, n0 and m0 force and moment of the weight in the scanned shape, and
d is the mass moment of the side branches per length. scipy solves this boundary value problem by
collocation; the force of a gripper that holds a pose is a parameter of it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.integrate import cumulative_trapezoid, solve_bvp, trapezoid
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from limber.core.errors import Option, WorkError
from limber.core.progress import SILENT, Progress
from limber.estimation.forward.observed_path import TURNED_PART, MotionWanted, sideways_forces
from limber.geometry.skeleton.skeleton import Skeleton

STATIONS = 400
"""Positions at which the properties of the rod are tabulated."""
FIRST_NODES, MOST_NODES = 40, 3000
"""Nodes of the collocation, to begin with and at most."""
TOLERANCE = 1e-4
"""Relative residual of the collocation."""
SHEAR_SHARE = 0.9
"""Part of a round section that carries shear (Cowper 1966, Poisson's ratio about 0.35)."""
HALVINGS = 6
"""Times that a step to another load or pose is halved if it has no solution at once."""


@dataclass(frozen=True)
class RodMotion:
    """A pull of a rod: poses [n, 6] of the grasp point, wrenches [n, 6] on it about the pose,
    stations [n, S, 3] with sections' rotations [n, S, 3, 3], and as scanned [S, 3]."""

    poses: np.ndarray
    wrenches: np.ndarray
    places: np.ndarray
    turns: np.ndarray
    axis: np.ndarray

    def seen(self, points: np.ndarray) -> np.ndarray:
        """Positions of points [m], [K, 3], that move with the nearest section, [n, K, 3]."""
        nearest = cKDTree(self.axis).query(points)[1]
        return self.places[:, nearest] + np.einsum(
            "nkij,kj->nki", self.turns[:, nearest], points - self.axis[nearest])


@dataclass(frozen=True)
class _State:
    """An equilibrium: at collocation nodes [N] [m] position, rotation (by rows) and moment [15, N],
    and the gripper's force [3] [N]."""

    along: np.ndarray
    values: np.ndarray
    force: np.ndarray

    @property
    def place(self) -> np.ndarray:
        """Position of the grasp [m], shape [3]."""
        return self.values[:3, -1]

    @property
    def turn(self) -> Rotation:
        """Rotation of the grasp."""
        return Rotation.from_matrix(self.values[3:12, -1].reshape(3, 3))


@dataclass(frozen=True)
class Rod:
    """A branch as a rod: stations' arc lengths [S] from base to grasp [m], and ``table`` [S, 19]:
    t; compliances in stretch, shear, bending, twist [1/N, 1/N, 1/(N m^2), 1/(N m^2)]; weight beyond
    [N]; n0 [N]; m0 [N m]; d [kg]. ``outer`` [kg m] is the mass beyond times its arm."""

    along: np.ndarray
    table: np.ndarray
    axis: np.ndarray
    gravity: np.ndarray
    outer: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, young_at: Callable[[np.ndarray], np.ndarray], poisson: float,
           density: float, gravity: np.ndarray, grasp_fraction: float, *, as_scanned: bool,
           ) -> "Rod":
        """Make a skeleton's rod, from modulus [n] [Pa] at [n, 3] [m]. Zero gravity: weightless;
        ``as_scanned``: the scan's shape is that under its weight."""
        path = skeleton.main_path()
        arc, along_all = skeleton.arc_length[path], skeleton.arc_length
        end = grasp_fraction * arc[-1]
        inner = path[arc < end - 1e-9]
        knots = np.r_[along_all[inner], end]
        grasp = skeleton.point_at(grasp_fraction)
        curve = CubicSpline(knots, np.vstack([skeleton.nodes[inner], grasp]))
        along = np.linspace(0.0, end, STATIONS)
        radius = np.interp(along, arc, skeleton.radius[path])
        area, second = np.pi * radius**2, np.pi / 4 * radius**4
        young = young_at(curve(along))
        shear = young / (2 * (1 + poisson))
        compliance = 1 / np.column_stack([young * area, SHEAR_SHARE * shear * area,
                                          young * second, 2 * shear * second])
        mass, arms, outer_mass, outer = _hung(skeleton, path, along, radius, end, grasp, curve,
                                              density)
        mass = mass + density * area
        beyond = outer_mass + _from_end(mass, along)
        weight = beyond[:, None] * gravity
        slope = curve(along, 1)
        moment = np.cross(outer, gravity) + np.column_stack([
            _from_end(each, along) for each in (np.cross(slope, weight)
                                                + np.cross(arms, gravity)).T])
        rest = (weight, moment) if as_scanned else (0 * weight, 0 * moment)
        return cls(along, np.hstack([slope, compliance, weight, *rest, arms]), curve(along),
                   np.asarray(gravity, float), outer)

    def pulled(self, requested: MotionWanted, *, progress: Progress = SILENT) -> RodMotion:
        """Pull it slowly as requested (``pull``, ``turned`` or ``weight``). WorkError if no force
        moves the grasp that far, or no equilibrium is found."""
        count = len(requested.times)
        if requested.kind == "weight":
            forces = np.linspace(0.0, 1.0, count)[:, None] * requested.weight
        else:
            directions = sideways_forces(requested.axis, count, turn=requested.turn,
                                         phase=requested.phase)
            forces = self._size_for(directions[-1], requested.travel) * directions
        states = [self._rest()]
        for number, force in enumerate(forces):
            progress(number / count, "pulling a rod", frame=number)
            states.append(self._under(force, states[-1]))
        states = states[1:]
        if requested.kind == "turned":
            states = [self._turned(each) for each in states]
        return self._motion(states)

    def _motion(self, states: list[_State]) -> RodMotion:
        poses, wrenches, courses = [], [], []
        for each in states:
            poses.append(np.r_[each.place, each.turn.as_rotvec()])
            outer = np.cross(each.turn.apply(self.outer), self.gravity)
            wrenches.append(np.r_[each.force, each.values[12:, -1] - outer])
            courses.append(CubicSpline(each.along, each.values, axis=1)(self.along))
        found = np.array(courses)
        turns = np.moveaxis(found[:, 3:12].reshape(len(states), 3, 3, -1), -1, 1)
        return RodMotion(np.array(poses), np.array(wrenches), np.moveaxis(found[:, :3], 1, 2),
                         turns, self.axis)

    def _size_for(self, direction: np.ndarray, travel: float) -> float:
        """Factor of a force [N] that moves the grasp by ``travel`` [m], to 3 %."""
        rest = self._rest()
        size, near, last = 0.1 * travel / (self.along[-1]**3 * self.table[:, 5].mean()), rest, 0.0
        for _ in range(60):
            try:
                found = self._under(size * direction, near)
            except WorkError:
                size = (size + last) / 2
                continue
            moved = float(np.linalg.norm(found.place - rest.place))
            if abs(moved - travel) < 0.03 * travel:
                return size
            if moved < travel:
                near, last = found, size
                size *= min(travel / moved, 2.0)
            else:
                size = last + (size - last) * travel / moved
        raise WorkError(f"No sideways force moves the grasp by {travel:.3g} m.", "The rod is too "
                        "short or too stiff at the grasp.", "Reduce the reach.")

    def _rest(self) -> _State:
        """The state that no gripper holds."""
        along = np.linspace(0.0, self.along[-1], FIRST_NODES)
        values = np.vstack([CubicSpline(self.along, self.axis)(along).T,
                            np.repeat(np.eye(3).reshape(9, 1), FIRST_NODES, 1),
                            self._smooth(along)[:, 13:16].T])
        return self._solved(_State(along, values, np.zeros(3)), np.zeros(3))

    def _under(self, force: np.ndarray, near: _State, halvings: int = HALVINGS) -> _State:
        """The state under a force of a gripper that lets the branch turn, from a known state."""
        try:
            return self._solved(near, force)
        except WorkError:
            if not halvings:
                raise
        between = self._under(0.5 * (force + near.force), near, halvings - 1)
        return self._under(force, between, halvings - 1)

    def _turned(self, free: _State) -> _State:
        """The state at the same place with less rotation."""
        whole, place, state = free.turn.as_rotvec(), free.place, free
        part, step = 1.0, 1.0 - TURNED_PART
        while part > TURNED_PART + 1e-9:
            try:
                state = self._solved(state, None, (place, Rotation.from_rotvec(
                    (part - step) * whole)))
                part -= step
            except WorkError:
                step /= 2
                if step < (1.0 - TURNED_PART) / 2**HALVINGS:
                    raise
        return state

    def _solved(self, near: _State, force: np.ndarray | None,
                pose: tuple[np.ndarray, Rotation] | None = None) -> _State:
        """The state near another one, under a force or held at a pose. WorkError if the collocation
        does not converge."""
        base = np.r_[self.axis[0], np.eye(3).ravel()]

        def off(begin: np.ndarray, end: np.ndarray, *unknown: np.ndarray) -> np.ndarray:
            turn = end[3:12].reshape(3, 3)
            if pose is None:
                return np.r_[begin[:12] - base, (end[12:] - np.cross(
                    turn @ self.outer, self.gravity)) / self._bending]
            relative = turn @ pose[1].as_matrix().T
            return np.r_[begin[:12] - base, (end[:3] - pose[0]) / self.along[-1],
                         relative[2, 1] - relative[1, 2], relative[0, 2] - relative[2, 0],
                         relative[1, 0] - relative[0, 1]]

        found = solve_bvp(
            lambda s, y, *unknown: self._slopes(s, y, *(unknown or (force,))), off,
            near.along, near.values, near.force if force is None else None, tol=TOLERANCE,
            max_nodes=MOST_NODES)
        if found.status or not np.isfinite(found.y).all():
            raise WorkError("The simulated rod finds no equilibrium.", "It is pulled too far, or "
                            "cannot carry its own weight.", "Reduce the reach, or "
                            "give ", Option("model", "tetrahedra"), ".")
        return _State(found.x, found.y, found.p if force is None else force)

    @cached_property
    def _smooth(self) -> CubicSpline:
        """The table between the stations."""
        return CubicSpline(self.along, self.table)

    @property
    def _bending(self) -> float:
        """Scale of moments: mean bending stiffness over the length [N m]."""
        return float(1 / (self.table[:, 5].mean() * self.along[-1]))

    def _slopes(self, along: np.ndarray, values: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Derivatives of position, rotation and moment at N positions, shape [15, N]."""
        row = self._smooth(along).T
        slope, (stretch, shear, bend, twist) = row[:3], row[3:7]
        turn, moment = values[3:12].reshape(3, 3, -1), values[12:]
        load = np.asarray(force)[:, None] + row[7:10]
        axis = slope / np.sqrt((slope**2).sum(axis=0))
        inside = [(turn * each[:, None]).sum(axis=0) - rest for each, rest in (
            (load, row[10:13]), (moment, row[13:16]))]
        strain, (x, y, z) = (weak * each + (stiff - weak) * axis * (axis * each).sum(axis=0)
                             for each, stiff, weak in zip(inside, (stretch, twist), (shear, bend),
                                                          strict=True))
        found = np.empty_like(values)
        moved = found[:3] = (turn * (slope + strain)).sum(axis=1)
        turned = found[3:12].reshape(3, 3, -1)
        turned[:, 0] = turn[:, 1] * z - turn[:, 2] * y
        turned[:, 1] = turn[:, 2] * x - turn[:, 0] * z
        turned[:, 2] = turn[:, 0] * y - turn[:, 1] * x
        arms = (turn * row[16:19]).sum(axis=1)
        found[12:] = _cross(load, moved) + _cross(self.gravity[:, None], arms)
        return found


def _cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.stack([one[1] * other[2] - one[2] * other[1], one[2] * other[0] - one[0] * other[2],
                     one[0] * other[1] - one[1] * other[0]])


def _from_end(values: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Integral from each station to the last one, shape [S]."""
    whole = cumulative_trapezoid(values, along, initial=0.0)
    return whole[-1] - whole


def _hung(skeleton: Skeleton, path: np.ndarray, along: np.ndarray, radius: np.ndarray, end: float,
          grasp: np.ndarray, curve: CubicSpline, density: float,
          ) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Masses that hang on the rod: side branches' per length [S] [kg/m] and their moment [S, 3]
    [kg], spread over the diameter at the fork; beyond the grasp mass [kg], moment [3] [kg m]."""
    arc, on_path = skeleton.arc_length, np.isin(np.arange(skeleton.node_count), path)
    root = np.arange(skeleton.node_count)
    for node in range(1, skeleton.node_count):
        if not on_path[node]:
            root[node] = root[skeleton.parent[node]]
    mass, moment, outer_mass, outer = np.zeros(len(along)), np.zeros((len(along), 3)), 0.0, 0.0
    for node in range(1, skeleton.node_count):
        before = skeleton.parent[node]
        low = np.clip((end - arc[before]) / max(arc[node] - arc[before], 1e-12), 0.0, 1.0) if (
            on_path[node]) else 0.0
        if on_path[node] and low >= 1.0:
            continue
        begin = skeleton.nodes[before] + low * (skeleton.nodes[node] - skeleton.nodes[before])
        own = density * np.pi * (0.5 * (skeleton.radius[node] + skeleton.radius[before]))**2 * (
            np.linalg.norm(skeleton.nodes[node] - begin))
        centre, fork = 0.5 * (begin + skeleton.nodes[node]), arc[root[node]]
        if on_path[node] or fork >= end:
            outer_mass, outer = outer_mass + own, outer + own * (centre - grasp)
            continue
        wide = max(np.interp(fork, along, radius), 2 * along[1])
        share = np.maximum(1 - np.abs(along - fork) / wide, 0.0)
        share *= own / trapezoid(share, along)
        mass += share
        moment += share[:, None] * (centre - curve(fork))
    return mass, moment, outer_mass, np.zeros(3) + outer
