"""Stage ``target``, and ``targets.json``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from limber.core.errors import InputError, Option, Text
from limber.core.progress import Progress
from limber.core.settings import POSITION, Groups
from limber.stages.result import Result, Vector, kept, shown
from limber.stages.stage import About, KeptStage, PlacedStage, argument
from limber.store import Branch

if TYPE_CHECKING:
    from limber.mechanics.loads.loaded_branch import NamedTarget

FILE = "targets.json"
_FARTHEST_M = 0.03  # from the branch at which a target may be


class Target(Result):
    """A named place on the branch; all but the name is None once it has been removed."""

    target: str = shown("name")
    position: Vector | None = kept("position at rest, in the branch's frame [m]")
    branch_point: Vector | None = kept("nearest point of the branch, which it follows [m]")
    distance: float | None = shown("distance from the branch", ".3g mm")
    mass: float | None = shown("mass that hung there when the branch was scanned", ".3g kg")


class SetTarget(KeptStage, PlacedStage):
    """Name a place on the branch, such as a flower, that all stages follow."""

    about = About(
        "target", 35, Target, key="target:{name}", reads=("mesh.vtu",), writes=("targets.json",),
        found=("{target} is at {position_m} m, {distance_m:m} from the branch, and weighs "
               "{mass_kg:kg}.",),
        then="limber energy {branch_folder}", step="plan", label="Name a Target")
    groups: ClassVar[Groups] = {"input": ("at", "mass", "remove")}
    common = ("at", "mass", "remove")

    name: str = argument("Name of the target: letters, digits, dash, underscore.")
    at: tuple[float, float, float] | None = Field(
        None, description="Position on the branch at rest, in the branch's frame [m].",
        json_schema_extra={"metavar": "X Y Z"} | POSITION)
    mass: float = Field(
        0.0, ge=0, le=100, description="Additional mass [kg] that hung there when the branch was "
        "scanned.")
    remove: bool = Field(False, description="Remove this target.")

    def run_in_branch(self, progress: Progress) -> dict[str, Any]:
        """Write a target into ``targets.json``, replacing one of that name, or remove it.

        It keeps the given position, and moves and rotates with the nearest point of the branch.

        Returns:
            ``target``, ``position_m``, ``mass_kg``; ``branch_point_m``, the nearest point of the
            branch, to which it is attached, ``distance_m`` from there; ``targets``, the names of
            all.

        Raises:
            InputError: the name is invalid, the position is missing, contradictory or off the
                branch, or there is nothing to remove.
        """
        from limber.store.loading import load_mesh, load_targets

        _check_request(self)
        branch = Branch.open(self.branch_folder)
        branch.require("mesh.vtu", "reconstruct")
        known = load_targets(branch)
        others = [target for target in known if target.name != self.name]
        requested = [] if self.at is None else [(self.name, self.at, self.mass)]
        is_there = requested == [(one.name, one.position, one.mass) for one in known
                                 if one.name == self.name]
        if is_there and self.is_kept(branch, reads=["mesh.vtu"]):
            return branch.manifest.stages[self.entry].result | {
                "targets": sorted(target.name for target in known)}
        with branch.stage(self.entry, self, reads=["mesh.vtu"]) as stage:
            if self.remove and len(others) == len(known):
                raise InputError(
                    f"{branch.folder} has no target {self.name}.",
                    f"It has {', '.join(target.name for target in others) or 'none'}.",
                    "Nothing was removed.")
            found = {} if self.at is None else _placed(load_mesh(branch), self.name, self.at,
                                                       self.mass)
            targets = others if self.at is None else [*others, found.pop("target")]
            stage.write(FILE, _content(targets))
            stage.result.update(
                {"target": self.name, **found,
                 "targets": sorted(target.name for target in targets)})
        return stage.result


def _check_request(asked: SetTarget) -> None:
    import re

    name = asked.name
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", name):
        raise InputError(f"{name!r} cannot name a target.",
                         "Names appear in files and tables of other programs.",
                         "Use letters, digits, dash and underscore, 64 at most.")
    if asked.remove == (asked.at is not None):
        both = ("Both ", " and ") if asked.remove else ("Neither ", " nor ")
        raise InputError(
            Text(both[0], Option("at"), both[1], Option("remove"), f" for target {name}."),
            "A target is either set at a position or removed.",
            "Give ", Option("at"), " X Y Z, or ", Option("remove", True), ".")
    if asked.at is not None and not np.isfinite(asked.at).all():
        raise InputError(f"Target {name} at {asked.at}.", "A position has three finite numbers.",
                         "Give ", Option("at"), " X Y Z in metres.")


def _placed(mesh: Any, name: str, at: tuple[float, float, float], mass: float,) -> dict[str, Any]:
    """Return the target and its attachment to the branch."""
    from limber.mechanics.loads.loaded_branch import NamedTarget
    from limber.mechanics.points import nearest_inside

    position = np.array(at)
    foot = nearest_inside(mesh, position[None])[0]
    distance = float(np.linalg.norm(position - foot))
    if not distance <= _FARTHEST_M:
        low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
        raise InputError(
            f"Target {name} is {distance:.3g} m away from the branch.",
            f"The branch extends from ({_numbers(low)}) to ({_numbers(high)}) m. Its nearest "
            f"point is ({_numbers(foot)}) m, and {_FARTHEST_M:g} m are allowed.",
            "Check the frame and the unit (metres, branch frame).")
    return {"target": NamedTarget(name, at, mass), "position_m": position,
            "mass_kg": mass, "branch_point_m": foot, "distance_m": distance}


def _numbers(point: np.ndarray) -> str:
    return ", ".join(f"{value:.3f}" for value in point)


def _content(targets: list[NamedTarget]) -> dict[str, Any]:
    from limber.store.loading import TARGETS_FORMAT

    entries = [{"name": target.name, "position_m": list(target.position), "mass_kg": target.mass}
               for target in sorted(targets, key=lambda target: target.name)]
    return {"format_version": TARGETS_FORMAT, "targets": entries}
