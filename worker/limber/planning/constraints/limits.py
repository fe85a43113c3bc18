"""Limits on every pose of a motion, with margins for the field, and their check on the full model.

A planner sees the field, which is wrong by its measured error. It therefore plans with limits that
are tighter by a margin: 95 % of the samples near the limit, each left out of the fit in turn, have
an error of at most this margin. Whether a limit is kept is decided on the full model alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from limber.cell.obstacles import Obstacle, closest

# Obstacles to branch and gripper: boxes and closed surfaces.
# Constraints on a plan in addition to the limits on energy, force and loads.
#
# A constraint returns its limited quantity for a state of the full model. The energy field learns
# it at its samples (:func:`~limber.planning.field.energy_field.knowing`), and with it the gradient
# and the error that margins and proofs use. An external constraint is made from settings by a
# function in :data:`~limber.planning.constraints.limits.CONSTRAINTS`.
from limber.core.errors import Command, InputError, Option, Text
from limber.mechanics.materials.materials import strain_limit
from limber.planning.field.energy_field import UNITS, EnergyField, FieldArrays
from limber.planning.field.radial import LocalError, slack_of
from limber.planning.field.stored_states import States
from limber.planning.goals.region import empty_along
from limber.planning.settings import PlanSettings


@dataclass(frozen=True)
class Broken:
    """A limit, named with its unit, that a state of the full model breaks at a grasp position [3]
    [m]."""

    name: str
    value: float
    limit: float
    position: np.ndarray

    @property
    def text(self) -> Text:
        position = ", ".join(f"{x:.3f}" for x in self.position)
        return Text(f"{self.name} {self.value:.4g} exceeds the limit {self.limit:.4g} at "
                    f"({position}) m").at(self.position)


class Constraint(Protocol):
    """A limit on the grasp's position and the branch's shape.

    Attributes:
        name: Unique, in small letters and underscores.
        limit: Largest allowed value, above 0.
    """

    name: str
    limit: float

    def values(self, grasps: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return the limited quantity of states with the grasp at ``grasps`` [k, 3] and the nodes
        at ``nodes`` [k, n, 3], both in m: never below 0, and smooth, shape [k].
        """
        ...

    def tightened(self, factor: float) -> "Constraint":
        """Return it with its limit divided by ``factor``."""
        ...

    def broken(self, grasps: np.ndarray, nodes: np.ndarray) -> str | None:
        """Describe where states break it most; None if they keep it."""
        values = self.values(grasps, nodes)
        worst = int(values.argmax())
        return Broken(self.name.replace("_", " "), float(values[worst]), self.limit,
                      grasps[worst]).text if values[worst] > self.limit else None


_SCALE = 0.1  # [m] in which closeness falls to a third


@dataclass(frozen=True)
class Obstacles(Constraint):
    """Bodies that the branch must not touch. Limited is the closeness ``exp(-d / 0.1 m)`` of the
    clearance d: 1 on contact, more inside; smooth for a planner's field."""

    @classmethod
    def keeping(cls, bodies: tuple[Obstacle, ...], clearance: float) -> "Obstacles":
        """Return the constraint to stay ``clearance`` [m] away from bodies."""
        return cls(bodies, float(np.exp(-clearance / _SCALE)))

    @property
    def clearance(self) -> float:
        """Clearance kept from the bodies [m]."""
        return -_SCALE * float(np.log(self.limit))

    bodies: tuple[Obstacle, ...]
    limit: float = 1.0
    name = "closeness"

    def values(self, grasps: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        return np.array([np.exp(-min(float(body.clearance(each).min()) for body in self.bodies)
                                / _SCALE) for each in nodes])

    def tightened(self, factor: float) -> "Obstacles":
        return replace(self, limit=self.limit / factor)

    def broken(self, grasps: np.ndarray, nodes: np.ndarray) -> str | None:
        kept = self.clearance
        if (hit := closest(self.bodies, nodes.reshape(-1, 3), kept)) is None:
            return None
        name, depth, where = hit
        position = ", ".join(f"{x:.3f}" for x in where)
        how, more = ("inside", "") if depth >= kept else (
            "away from", f", less than the clearance of {1e3 * kept:.1f} mm")
        return Text(f"the branch is {1e3 * abs(kept - depth):.1f} mm {how} {name} at ({position}) "
                    f"m{more}").at(where)


_COVERED = 0.95  # fraction of the samples near a limit
_NEAR = (0.5, 1.3)  # fractions of the limit that count as near
_FEWEST = 12  # fewest samples near it; otherwise all are used
_MOST = 0.3  # fraction of the limit; where the field is worse, the check on the full model decides


SURELY = -1.0
"""The share of :meth:`Limits.on` with which the field exceeds a limit only where the branch does.
"""
CONSTRAINTS: list[Callable[[PlanSettings], Constraint | None]] = []
"""Makes external constraints from a plan's settings, or None if none is requested."""


@dataclass(frozen=True)
class Limits:
    """The limits as requested, infinite if none: energy above hanging [J], force [N] and torque [N
    m] of the gripper, its pull or push along the branch [N], largest principal strain and stress
    [Pa], and a box [3] [m] for the grasp."""

    energy: float = np.inf
    force: float = np.inf
    strain: float = np.inf
    stress: float = np.inf
    axial_force: float = np.inf
    torque: float = np.inf
    low: np.ndarray = field(default_factory=lambda: np.full(3, -np.inf))
    high: np.ndarray = field(default_factory=lambda: np.full(3, np.inf))
    constraints: tuple[Constraint, ...] = ()

    def with_cell(self, low: np.ndarray | None, high: np.ndarray | None, force: float,
                  obstacles: tuple[Obstacle, ...], clearance: float = 0.0) -> "Limits":
        """Return the limits with those of a robot's cell added; ``clearance`` [m] is kept from its
        obstacles. InputError if the workspaces do not intersect."""
        more = (Obstacles.keeping(obstacles, clearance),) if obstacles else ()
        both = replace(self, force=min(self.force, force),
                       constraints=(*more, *self.constraints),
                       low=self.low if low is None else np.maximum(self.low, low),
                       high=self.high if high is None else np.minimum(self.high, high))
        if not (both.low < both.high).all():
            raise InputError("The given workspace and the cell's workspace do not overlap.",
                             f"Their intersection is empty {empty_along(both.low, both.high)}.",
                             "Correct ", Option("workspace"), ", or the cell file.")
        return both

    def values(self, grasps: np.ndarray, nodes: np.ndarray) -> dict[str, np.ndarray]:
        """Return the constraints' quantities of states with the grasp at ``grasps`` [k, 3] and the
        nodes at ``nodes`` [k, n, 3], by name, shape [k] each."""
        return {each.name: each.values(grasps, nodes) for each in self.constraints}

    def met(self, grasps: np.ndarray, nodes: np.ndarray) -> list[str]:
        """Describe the constraints that such states break."""
        return [words for each in self.constraints if (words := each.broken(grasps, nodes))]

    @classmethod
    def of(cls, settings: PlanSettings, stiffer: float = 1.0) -> "Limits":
        """Return the settings' limits; by ``stiffer``, a possible modulus over its estimate, the
        stress may be larger. InputError if the workspace is empty or strain limited twice."""
        strain = settings.max_strain or np.inf
        if settings.wood is not None and settings.max_damage is None:
            if settings.max_strain is not None:
                raise InputError(
                    Text("Both ", Option("max_strain"), " and ", Option("wood"), " are given."),
                    "Both limit the strain.", "Give only one of them.")
            strain = strain_limit(settings.wood)
        low, high = np.array(settings.workspace or [-np.inf] * 3 + [np.inf] * 3).reshape(2, 3)
        if not (low < high).all():
            raise InputError(f"The workspace is empty {empty_along(low, high)}.",
                             "Its lower corner must be below the upper one in x, y and z.",
                             "Correct ", Option("workspace"), ".")
        return cls(settings.max_energy or np.inf, settings.max_force or np.inf,
                   strain, (settings.max_stress or np.inf) / stiffer,
                   settings.max_axial_force or np.inf, settings.max_torque or np.inf, low=low,
                   high=high, constraints=tuple(made for make in CONSTRAINTS
                                                if (made := make(settings)) is not None))

    def tightened(self, factors: dict[str, float]) -> "Limits":
        """Return the limits divided by ``factors``, by the names of ``asked``."""
        of_loads: Any = {name: limit / factors[name] for name, limit in self.asked_loads().items()
                    if name in factors}
        return replace(self, **of_loads, constraints=tuple(
            each.tightened(factors[each.name]) if each.name in factors else each
            for each in self.constraints))

    def asked_loads(self) -> dict[str, float]:
        """Return the requested limits without constraints, by the names of ``UNITS``."""
        limits = {name: getattr(self, name, np.inf) for name in UNITS}
        return {name: limit for name, limit in limits.items() if limit < np.inf}

    def asked(self) -> dict[str, float]:
        """Return the requested limits, by the names of ``UNITS`` and of constraints."""
        return self.asked_loads() | {each.name: each.limit for each in self.constraints}

    def margins(self, known: EnergyField) -> "dict[str, float]":
        """Return how much tighter than requested to plan on a field: by limit, 0 without one."""
        missed = {"energy": known.missed[:, 0],
                  "force": np.linalg.norm(known.missed[:, 1:4], axis=1),
                  **dict(zip(known.load_names, known.missed[:, 4:].T, strict=True))}
        values, inner = known.samples.sizes, known.tested
        found = dict.fromkeys(UNITS, 0.0)
        for name, limit in self.asked().items():
            value = values.get(name)
            if value is None:
                raise InputError(f"The energy field contains no {name.replace('_', ' ')}.", "It "
                                 "was sampled without it.", "Run ", Command("energy"), " again "
                                 "with ", Option("force", True), ".")
            size = np.abs(value)
            near = inner & (size > _NEAR[0] * limit) & (size < _NEAR[1] * limit)
            near = near if near.sum() >= _FEWEST else inner
            off = np.quantile(np.abs(missed[name][near]), _COVERED)
            found[name] = min(float(off), _MOST * limit) if off < np.inf else _MOST * limit
        return found

    def doubts(self, known: EnergyField) -> "dict[str, float]":
        """By limit, how far the field may exceed it at a pose that keeps it (0: not asked,
        infinite: unknown): its largest overestimate, fitted without it, at samples not far over.
        Proofs need this; margins that most poses keep suffice for a plan that is checked."""
        found = dict.fromkeys(UNITS, 0.0)
        inner, values = known.tested, known.samples.sizes
        above = self.above(known)
        for name, limit in self.asked().items():
            size = values.get(name)
            if size is None:
                found[name] = np.inf
                continue
            more = above[name]
            sure = inner & np.isfinite(more)
            near = sure & (np.abs(size) < _NEAR[1] * limit)
            near = near if near.sum() >= _FEWEST else sure
            found[name] = float(more[near].max(initial=0.0)) if near.any() else np.inf
        return found

    def in_words(self) -> str:
        """Describe the requested limits, or return an empty string."""
        kept = [f"{name.replace('_', ' ')} {limit:.3g} {UNITS.get(name, '')}".rstrip()
                for name, limit in self.asked().items()]
        return (" at most " + " and ".join(kept)) if kept else ""

    @staticmethod
    def above(known: EnergyField) -> dict[str, np.ndarray]:
        """Return the field's overestimate at each sample, fitted without it, by the names of
        ``UNITS`` and of constraints, shape [m] each; nan if not known."""
        samples, missed = known.samples, known.missed
        size = np.linalg.norm(samples.forces, axis=1)
        above = {"energy": missed[:, 0],
                 "force": np.linalg.norm(samples.forces + missed[:, 1:4], axis=1) - size}
        table = samples.load_table
        more = np.abs(table + missed[:, 4:]) - np.abs(table)
        return above | dict(zip(known.load_names, more.T, strict=True))

    def errors(self, known: EnergyField) -> dict[str, LocalError]:
        """Return the field's possible overestimate as a function of the position in the plain
        chart, by limit: no left-out sample exceeded it; nowhere more than :meth:`doubts`."""
        doubts = self.doubts(known)
        return self._local(known, 1.0, 1.0, {name: doubts[name] for name in self.asked()
                                             if np.isfinite(doubts[name])})

    def on(self, known: EnergyField, share: float = 0.0) -> FieldArrays:
        """Return the field with these limits for the kernels. Above 0, they are tighter at each
        position by a ``share`` of the field's possible underestimate there, which 95 % of the
        left-out samples keep. Below 0 (:data:`SURELY`), they are looser by the possible
        overestimate, which none exceeded: infinite where it is not known."""
        limits, errors = self.asked(), dict[str, LocalError]()
        if share > 0.0:
            errors = self._local(known, -1.0, _COVERED, {
                name: _MOST * limit for name, limit in limits.items()})
        elif share < 0.0:
            errors = self.errors(known)
            limits = {name: limits[name] for name in errors}
        return known.limited(limits.pop("energy", np.inf), limits.pop("force", np.inf),
                             low=self.low, high=self.high, slack=slack_of(
                                 ("energy", "force", *known.load_names), errors, share), **limits)

    def _local(self, known: EnergyField, side: float, covered: float, most: dict[str, float],
               ) -> dict[str, LocalError]:
        """Return the errors of the limits of ``most``; on the ``side`` of overestimates, 1, or
        underestimates, -1."""
        inner, above = known.tested, self.above(known)
        mapped = known.region.chart.plain.map(known.samples.positions)[inner]
        return {name: LocalError.of(mapped, side * above[name][inner], covered, limit)
                for name, limit in most.items()}

    def broken(self, states: States) -> list[Broken]:
        """Return the limits that states of the full model break, each at its worst state."""
        positions = states.poses[:, :3]
        outside = np.maximum(self.low - positions, positions - self.high).max(axis=1)
        asked = [(f"{name.replace('_', ' ')} [{UNITS[name]}]".replace(" []", ""), size,
                  getattr(self, name)) for name, size in states.sizes.items()]
        asked.append(("distance outside the workspace [m]", outside, 1e-6))
        return [Broken(name, float(values.max()), limit, positions[values.argmax()])
                for name, values, limit in asked if values.max() > limit]

    def kept(self, states: States) -> np.ndarray:
        """Return which states keep all limits, bool [n]."""
        positions = states.poses[:, :3]
        within = [size <= getattr(self, name) for name, size in states.sizes.items()]
        return (np.logical_and.reduce(within)
                & (positions >= self.low - 1e-6).all(axis=1)
                & (positions <= self.high + 1e-6).all(axis=1))


def with_unit(name: str) -> str:
    """Return the key that a limit of ``UNITS`` has in files: its name and unit."""
    return f"{name}_{UNITS[name].lower()}".rstrip("_")


def limits_in_file(entries: dict[str, dict[str, float]]) -> Limits:
    """Return the limits in a plan's file, by the keys of :func:`with_unit`."""
    known: Any = {name: float(entries[with_unit(name)]["limit"]) for name in UNITS
                  if with_unit(name) in entries}
    return Limits(**known)
