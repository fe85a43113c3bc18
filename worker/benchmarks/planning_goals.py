"""Goals in regions of any size: balls, a second arm's reach, a camera's view; and unreachable ones.

A region is drawn so that its border passes near a position that the tip has in a state of the full
model, a sample of the field: so it is reachable. A fraction of the poses, 20 to 80 % for large
regions, is inside. The start is outside. The end is checked on the full model.
"""

import time
from dataclasses import dataclass

import numpy as np

from benchmarks.table import Asked, Row
from limber.core.errors import LimberError, NoPathError
from limber.core.numerics.rigid import pose_vectors
from limber.planning.field.energy_field import EnergyField
from limber.planning.field.grasp_model import GraspModel
from limber.planning.goals.goal import CellPlace, GoalRequest
from limber.planning.goals.goal_kinds import goal_of
from limber.planning.make_plan import plan_motion
from limber.planning.settings import PlanSettings
from limber.robot.cell.cell import Cell
from limber.stages.paths.plan_cell import cell_positions

_KINDS = (0.005, 0.05, 0.3, 1.0, "second_arm", "in_view")
"""Radii of balls [m], and regions that a cell gives."""
_SHARES = (0.2, 0.8)
_TRIES = 60
_POSES = 400
_FAR = 5.0  # [m] to where nothing reaches

GOAL_ROWS = (
    Asked("goals of the tip: balls of 5 mm to 1 m, second arm, view, reachable: planned",
          "60 of 60"),
    Asked("there: processor time, median / worst", "-"),
    Asked("unreachable: refused with its reason", "20 of 20"))


@dataclass
class RegionGoal:
    """Result for one goal.

    ``branch``, ``seed`` and ``source`` (digest of the sources) identify it; ``share`` is the
    fraction of the poses inside.
    """

    number: int
    branch: str = ""
    seed: int = 0
    source: str = ""
    kind: str = ""
    share: float = 0.0
    seconds: float = 0.0
    planned: bool = False
    refused: str = ""
    trouble: str = ""


def run_region_goal(model: GraspModel, known: EnergyField, number: int, seed: int, **whose: str,
                    ) -> RegionGoal:
    """Draw a goal of a kind, plan to it from outside, and try one out of reach."""
    # Seeds of six branches at one number, and of six numbers on one branch, give every kind.
    kind = _KINDS[seed % len(_KINDS)]
    found = RegionGoal(number, seed=seed, kind=str(kind), **whose)
    generator = np.random.default_rng([seed, number])
    try:
        settings, cell, start = _drawn(found, kind, known, model, generator)
    except LimberError as error:
        found.trouble = f"no goal drawn: {error}"
        return found
    began = time.process_time()
    try:
        motion = plan_motion(known, model, settings.model_copy(update={
            "start": tuple(map(float, start))}), cell=cell, workers=1)
        found.planned = motion.summary["plan"]["length_m"] > 0.0
    except LimberError as error:
        found.trouble = f"{type(error).__name__}: {error}"
    found.seconds = time.process_time() - began
    found.refused = _refused(kind, known, model)
    return found


def _drawn(found: RegionGoal, kind: float | str, known: EnergyField, model: GraspModel,
           generator: np.random.Generator,
           ) -> tuple[PlanSettings, dict[str, CellPlace], np.ndarray]:
    """Return settings, the cell's places and a start outside the goal."""
    points = known.region.draw(_POSES, generator)
    reached = known.samples.tips[known.region.contains(known.samples.positions)]
    for _ in range(_TRIES):
        settings, cell = _asked(kind, reached, generator)
        try:
            goal = goal_of(GoalRequest(known, model, settings, known.limited(), cell))
        except NoPathError:
            continue
        away = goal.distance(known, points) - goal.tolerance
        found.share = float((away <= 0.0).mean())
        low, high = (0.0, 1.0) if kind in (0.005, 0.05) else _SHARES
        if low <= found.share <= high and away.max() > 0.005:
            return settings, cell, points[int(np.argmax(away))]
    raise NoPathError(f"{_TRIES} regions of kind {kind} had no fitting share of poses.")


def _asked(kind: float | str, tips: np.ndarray, generator: np.random.Generator,
           ) -> tuple[PlanSettings, dict[str, CellPlace]]:
    place = tips[generator.integers(len(tips))]
    outward = generator.normal(size=3)
    outward /= np.linalg.norm(outward)
    common = {"inertia": False, "iterations": 500, "field_error": 20.0}
    if not isinstance(kind, str):
        # Its border is a little behind a position that the tip reaches.
        centre = place + (kind - min(0.5 * kind, 0.01)) * outward
        return PlanSettings(tip_goal=tuple(map(float, centre)), goal_tolerance=kind, **common), {}
    settings = PlanSettings(**{kind: True}, **common)
    return settings, cell_positions(_cell(kind, place, generator.uniform(0.0, 2.0 * np.pi),
                                          generator.uniform(0.75, 1.0)))


def _cell(kind: str, place: np.ndarray, turn: float, far: float) -> Cell:
    """Return a cell with a second arm, or camera, ``far`` [m] sideways from a position."""
    aside = np.array([np.cos(turn), np.sin(turn), 0.0])
    stand = {"robot": {"model": "ur5e"}, "base": {"pose": (0.0,) * 6}}
    if kind == "second_arm":
        base = place - far * aside
        return Cell(**stand, second_arm={"model": "ur5", "base_pose": (
            float(base[0]), float(base[1]), 0.0, 0.0, 0.0, 0.0)})
    # Camera axes: x right, y down, z ahead.
    frame = np.eye(4)
    frame[:3, 0], frame[:3, 1], frame[:3, 2] = np.cross([0, 0, -1.0], aside), [0, 0, -1.0], aside
    frame[:3, 3] = place - far * aside
    return Cell(**stand, camera={"mount": "branch", "pose": tuple(map(
        float, pose_vectors(frame))),
                                 "range_m": (0.2, far + 0.01)})


def _refused(kind: float | str, known: EnergyField, model: GraspModel) -> str:
    """Return why a goal out of reach is refused; empty if it is not."""
    place = known.tip(known.rest[None])[0] + [_FAR, 0.0, 0.0]
    settings, cell = _asked(kind, place[None], np.random.default_rng(0))
    if kind == "in_view":
        cell = cell_positions(_cell("in_view", place, 0.0, 1.0))
    try:
        plan_motion(known, model, settings, cell=cell, workers=1)
    except LimberError as error:
        return error.seen
    return ""


def goal_rows(trials: list[RegionGoal]) -> list[Row]:
    """Return the rows of goals in regions."""
    drawn = [one for one in trials if not one.trouble.startswith("no goal drawn")]
    if not drawn:
        return [asked.not_shown() for asked in GOAL_ROWS]
    failed = [f"{one.branch} {one.kind}: {one.trouble}" for one in drawn if not one.planned]
    seconds = np.array([one.seconds for one in drawn])
    refused = sum(bool(one.refused) for one in drawn)
    return [
        Row(*GOAL_ROWS[0], f"{sum(one.planned for one in drawn)} of {len(drawn)}" + "".join(
            f"; {one[:160]}" for one in failed[:3]), not failed, len(drawn)),
        Row(*GOAL_ROWS[1], f"{np.median(seconds):.1f} / {seconds.max():.1f} s", None, len(drawn)),
        Row(*GOAL_ROWS[2], f"{refused} of {len(drawn)}", refused == len(drawn), len(drawn))]
