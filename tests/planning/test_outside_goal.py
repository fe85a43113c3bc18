"""A kind of goal from outside: one file, with its own setting, planned to as any other."""

import json
import shutil
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from pydantic import Field
from tests.stages.specified import Planned
from tests.stages.test_registry import parsed

from limber.core.errors import InputError, NoPathError
from limber.core.settings import Groups
from limber.planning.goals.goal import GRASP, Goal, GoalKind
from limber.planning.goals.goal_kinds import KINDS
from limber.planning.plan_file import read_plan
from limber.results.scene.animation import _goal as drawn
from limber.stages.paths import plan as plan_stage

pytestmark = pytest.mark.usefixtures("rough_plan")


class SidePaths(Planned):
    """Those of a plan, and how far to the side."""

    groups: ClassVar[Groups] = {"start and goal": ("goal_side",)}
    goal_side: float | None = Field(None, description="How far along x the grasp shall be [m].")


@dataclass(frozen=True)
class Slab:
    """The points within ``depth`` [m] of the plane at ``x`` [m]."""

    x: float
    depth: float
    words = "a slab"

    @property
    def middle(self):
        return np.array([self.x, 0.0, 0.4])

    def distance(self, points):
        return np.abs(np.asarray(points)[:, 0] - self.x) - self.depth


class SideGoal(Goal):
    """The grasp in a slab, with its own draws, and a condition on the end."""

    def guess(self, field, count, generator):
        drawn = field.region.draw(20 * count, generator)
        return drawn[self.excess(field, drawn) <= 0.0][:count]

    def centre(self, field):
        points = self.guess(field, 200, np.random.default_rng(0))
        return points[np.argmin(field.energy(points))]

    def require_end(self, grasp_model, states):
        if states.energies[-1] > 1.0:
            raise NoPathError("The branch is bent too far there.", "", "")

    def describe(self):
        return super().describe() | {"kind": "side", "x_m": self.region.x}

    def describe_end(self, states):
        return {"side_end_m": states.poses[-1, 0]}


@pytest.fixture
def side():
    """The kind, known while a test runs."""
    kind = GoalKind("goal_side", lambda asked, x: SideGoal(
        GRASP, Slab(x, asked.settings.goal_tolerance), advice="Choose another plane"))
    KINDS.append(kind)
    yield kind
    KINDS.remove(kind)


@pytest.mark.slow
@pytest.mark.usefixtures("side", "coarse_bound")
def test_a_goal_from_outside_is_planned_to(planned_branch, tmp_path):
    """The stage plans to it; the end is in it on the full model, no path costs less than the bound
    says, and file and picture show it."""
    folder = shutil.copytree(planned_branch, tmp_path / "copy.branch")
    rest = read_plan(folder / "plans/there.json").motion.poses[0]
    asked = SidePaths(goal_side=round(rest[0] + 0.08, 6), iterations=100, branch_folder=folder,
                      name="side")
    done = asked.run()
    told = json.loads((folder / "plans/side.json").read_text())
    assert told["goal"] == {"kind": "side", "x_m": asked.goal_side, "chosen": False,
                            "position_m": [asked.goal_side, 0.0, 0.4], "tolerance_m": 0.01}
    assert abs(told["plan"]["poses"][-1][0] - asked.goal_side) <= 0.01 * 1.001
    assert told["side_end_m"] == told["plan"]["poses"][-1][0]
    bound = done["certificate"]
    assert 0.0 < bound["lower_bound"] <= bound["upper_bound"]
    assert bound["full_model"]["lower_bound"] <= bound["full_model"]["cost"]
    assert read_plan(folder / "plans/side.json").summary["goal"]["kind"] == "side"
    assert drawn(told, None)["kind"] == "side"
    assert asked.run() == done


def test_a_goal_from_outside_has_its_option(monkeypatch):
    """The command with those settings takes it."""
    monkeypatch.setattr(plan_stage, "PlanPaths", SidePaths)
    assert parsed("plan", ["a.branch", "--goal-side", "0.3"]) == SidePaths(
        branch_folder="a.branch", goal_side=0.3)


@pytest.mark.usefixtures("side")
def test_it_is_refused_beside_another_goal(planned_branch):
    """By the name of its option, as any two; a target needs one that is of a target."""
    for more, words in (({"goal": (0, 0, 1)}, "--goal and --goal-side"),
                        ({"target": "flower"}, "without a goal for it")):
        with pytest.raises(InputError, match=words):
            SidePaths(goal_side=0.1, **more, branch_folder=planned_branch, name="bad").run()
