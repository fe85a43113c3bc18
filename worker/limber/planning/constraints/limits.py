"""What no pose of a motion may exceed, with margins for the field, and its check on the full model.

A planner sees the field, which is wrong by its measured error. It therefore plans with limits that
are tighter by a margin: what 95 % of the samples near the limit, each left out of the fit in turn,
are missed by at most. Whether a limit is kept is decided on the full model alone.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from limber.core.errors import InputError
from limber.mechanics.materials.species import strain_limit
from limber.planning.constraints.obstacles import Obstacle, closeness, closest
from limber.planning.field.energy_field import LOADS, EnergyField, FieldArrays, GraspSamples
from limber.planning.path_on_full_model import SolvedPoses
from limber.planning.settings import PlanSettings

UNITS = {"energy": "J", "force": "N", "strain": "", "stress": "Pa", "axial_force": "N",
         "torque": "Nm", "closeness": ""}
"""Of the limits, by the names that they have in :class:`Limits`."""

_COVERED = 0.95  # of the samples near a limit
_NEAR = (0.5, 1.3)  # times the limit
_FEWEST = 12  # samples near it; else all are asked
_MOST = 0.3  # of the limit: where the field is worse, the check on the full model has to tell


@dataclass(frozen=True)
class Broken:
    """A limit that a state of the full model does not keep.

    Attributes:
        name: Which, with its unit.
        value, limit: The state's and what was asked.
        position: Of the grasp there [m], shape [3].
    """

    name: str
    value: float
    limit: float
    position: np.ndarray

    def __str__(self) -> str:
        place = ", ".join(f"{x:.3f}" for x in self.position)
        return f"{self.name} {self.value:.4g} where {self.limit:.4g} is allowed, at ({place}) m"


@dataclass(frozen=True)
class Limits:
    """Limits as asked; infinite where nothing was.

    Attributes:
        energy: Above the hanging state [J].
        force: Magnitude of the gripper's [N].
        strain, stress: Largest principal anywhere in the branch, stress in Pa.
        axial_force: Of the gripper along the branch, pulling or pushing [N].
        torque: Of the gripper [Nm].
        closeness: Of the branch to the obstacles (:func:`~.obstacles.closeness`).
        low, high: Box that the grasp stays in [m], shape [3].
        obstacles: Bodies that the branch must not meet.
    """

    energy: float = np.inf
    force: float = np.inf
    strain: float = np.inf
    stress: float = np.inf
    axial_force: float = np.inf
    torque: float = np.inf
    closeness: float = np.inf
    low: np.ndarray = field(default_factory=lambda: np.full(3, -np.inf))
    high: np.ndarray = field(default_factory=lambda: np.full(3, np.inf))
    obstacles: tuple[Obstacle, ...] = ()

    def with_cell(self, low: np.ndarray | None, high: np.ndarray | None, force: float,
                  obstacles: tuple[Obstacle, ...]) -> "Limits":
        """Return the limits with those of a robot's cell besides.

        Raises:
            InputError: the workspaces have nothing in common.
        """
        both = replace(self, force=min(self.force, force), obstacles=obstacles,
                       closeness=1.0 if obstacles else np.inf,
                       low=self.low if low is None else np.maximum(self.low, low),
                       high=self.high if high is None else np.minimum(self.high, high))
        if not (both.low < both.high).all():
            raise InputError("The workspace and that of the cell have nothing in common.",
                             f"Together they go from {both.low} to {both.high} m.",
                             "Correct --workspace-low and --workspace-high, or the cell file.")
        return both

    def closeness_of(self, nodes: np.ndarray, displacements: np.ndarray) -> np.ndarray:
        """Return how close the branch is to obstacles in states [k, n, 3], shape [k]."""
        return np.array([closeness(self.obstacles, nodes + moved) for moved in displacements])

    def met(self, states: SolvedPoses, nodes: np.ndarray) -> str | None:
        """Return in words where the branch, with ``nodes`` [n, 3] at rest, meets an obstacle."""
        if not self.obstacles:
            return None
        places = (nodes + states.displacements).reshape(-1, 3)
        if (hit := closest(self.obstacles, places)) is None:
            return None
        name, depth, where = hit
        place = ", ".join(f"{x:.3f}" for x in where)
        return f"the branch is {1e3 * depth:.1f} mm inside {name} at ({place}) m"

    @classmethod
    def of(cls, settings: PlanSettings, stiffer: float = 1.0) -> "Limits":
        """Return the settings' limits.

        ``stiffer`` is how many times Young's modulus may be what was estimated: so much more may
        the stress be than what a model with the estimate says.

        Raises:
            InputError: the workspace is empty, or the strain limited twice.
        """
        strain = settings.max_strain or np.inf
        if settings.wood is not None:
            if settings.max_strain is not None:
                raise InputError("--max-strain and --wood are given.", "Both limit the strain.",
                                 "Give one of them.")
            strain = strain_limit(settings.wood)
        low = np.array(settings.workspace_low or [-np.inf] * 3, float)
        high = np.array(settings.workspace_high or [np.inf] * 3, float)
        if not (low < high).all():
            raise InputError(f"The workspace from {low} to {high} m is empty.",
                             "Its lower corner must be below the upper one in x, y and z.",
                             "Correct --workspace-low and --workspace-high.")
        return cls(settings.max_energy or np.inf, settings.max_force or np.inf,
                   strain, (settings.max_stress or np.inf) / stiffer,
                   settings.max_axial_force or np.inf, settings.max_torque or np.inf, low=low,
                   high=high)

    def tightened(self, factors: dict[str, float]) -> "Limits":
        """Return the limits divided by ``factors``, by the names of ``UNITS``."""
        return replace(self, **{name: getattr(self, name) / factor
                                for name, factor in factors.items()})

    def asked(self) -> dict[str, float]:
        """Return the limits that were asked for, by the names of ``UNITS``."""
        return {name: getattr(self, name) for name in UNITS if getattr(self, name) < np.inf}

    def margins(self, known: EnergyField) -> "dict[str, float]":
        """Return how much tighter than asked to plan on a field: by limit, 0 for none asked."""
        missed = {"energy": known.missed[:, 0],
                  "force": np.linalg.norm(known.missed[:, 1:4], axis=1),
                  **dict(zip(LOADS, known.missed[:, 4:].T, strict=True))}
        values, inner = _sampled(known.samples), ~known.region.is_face()
        found = dict.fromkeys(UNITS, 0.0)
        for name, limit in self.asked().items():
            if values[name] is None:
                raise InputError(f"The energy field knows no {name.replace('_', ' ')}.",
                                 "It was sampled by an older program.",
                                 "Run `limber energy` again with --force.")
            size = np.abs(values[name])
            near = inner & (size > _NEAR[0] * limit) & (size < _NEAR[1] * limit)
            near = near if near.sum() >= _FEWEST else inner
            off = np.quantile(np.abs(missed[name][near]), _COVERED)
            found[name] = min(float(off), _MOST * limit) if off < np.inf else _MOST * limit
        return found

    def doubts(self, known: EnergyField) -> "dict[str, float]":
        """Return by how much more than a limit the field may say of a pose that keeps it: by
        limit, 0 for none asked, infinite where the field's error is not known.

        The most that the field, fitted without it, says too much of a sample that keeps the limit
        or is not far over it. A proof that no path keeps the limits counts on that: margins, which
        most poses keep, would do for a plan that is checked afterwards, and for no proof.
        """
        found = dict.fromkeys(UNITS, 0.0)
        inner, values = ~known.region.is_face(), _sampled(known.samples)
        above = _above(known)
        for name, limit in self.asked().items():
            size, more = values[name], above[name]
            if size is None:
                found[name] = np.inf
                continue
            sure = inner & np.isfinite(more)
            near = sure & (np.abs(size) < _NEAR[1] * limit)
            near = near if near.sum() >= _FEWEST else sure
            found[name] = float(more[near].max(initial=0.0)) if near.any() else np.inf
        return found

    def beyond(self, known: EnergyField) -> FieldArrays:
        """Return the field with limits that it exceeds only where the branch exceeds these."""
        return self.on(known, {name: -more for name, more in self.doubts(known).items()})

    def on(self, known: EnergyField, margins: dict[str, float] | None = None) -> FieldArrays:
        """Return the field with these limits for compiled loops, tighter by ``margins``."""
        less = margins or dict.fromkeys(UNITS, 0.0)
        tighter = {name: getattr(self, name) - less[name] for name in UNITS}
        return known.limited(tighter.pop("energy"), tighter.pop("force"), low=self.low,
                             high=self.high, **tighter)

    def broken(self, states: SolvedPoses) -> list[Broken]:
        """Return the limits that states of the full model break, each where it is worst."""
        places = states.poses[:, :3]
        outside = np.maximum(self.low - places, places - self.high).max(axis=1)
        asked = [(f"{name.replace('_', ' ')} [{UNITS[name]}]".replace(" []", ""), size,
                  getattr(self, name)) for name, size in sizes(states).items()]
        asked.append(("distance outside the workspace [m]", outside, 1e-6))
        return [Broken(name, float(values.max()), limit, places[values.argmax()])
                for name, values, limit in asked if values.max() > limit]

    def kept(self, states: SolvedPoses) -> np.ndarray:
        """Return which states keep all limits, bool [n]."""
        places = states.poses[:, :3]
        within = [size <= getattr(self, name) for name, size in sizes(states).items()]
        return (np.logical_and.reduce(within)
                & (places >= self.low - 1e-6).all(axis=1)
                & (places <= self.high + 1e-6).all(axis=1))


def _sampled(samples: GraspSamples) -> "dict[str, np.ndarray | None]":
    """Return what limits are on at samples, by the names of ``UNITS``, shape [m] each."""
    return {"energy": samples.energies, "force": np.linalg.norm(samples.forces, axis=1),
            **samples.loads}


def _above(known: EnergyField) -> dict[str, np.ndarray]:
    """Return by how much the field, fitted without it, says too much of each sample, by the names
    of ``UNITS``, shape [m] each; nan where that is not known."""
    samples, missed = known.samples, known.missed
    size = np.linalg.norm(samples.forces, axis=1)
    above = {"energy": missed[:, 0],
             "force": np.linalg.norm(samples.forces + missed[:, 1:4], axis=1) - size}
    table = samples.load_table
    more = np.abs(table + missed[:, 4:]) - np.abs(table)
    return above | dict(zip(LOADS, more.T, strict=True))


def with_unit(name: str) -> str:
    """Return the key that a limit of ``UNITS`` has in files: its name and unit."""
    return f"{name}_{UNITS[name].lower()}".rstrip("_")


def limits_in_file(told: dict[str, dict[str, float]]) -> Limits:
    """Return the limits that a plan's file tells, by the keys of :func:`with_unit`."""
    return Limits(**{name: float(told[with_unit(name)]["limit"]) for name in UNITS
                     if with_unit(name) in told})


def sizes(states: SolvedPoses) -> dict[str, np.ndarray]:
    """Return what limits are on, by the names of ``UNITS``, shape [n] each."""
    return {"energy": states.energies, "force": states.force_sizes,
            **{name: np.abs(values) for name, values in states.loads.items()}}
