"""A constraint from outside: one file, with its own settings, kept as any limit is."""

import shutil
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from pydantic import Field
from tests.stages.specified import Planned

from limber.core.errors import NoPathError
from limber.core.settings import Groups
from limber.planning.constraints.limits import CONSTRAINTS, Constraint
from limber.planning.plan_file import read_plan

pytestmark = pytest.mark.usefixtures("rough_plan")
RADIUS = 0.015  # [m]
SOFT = 0.04  # [m] over which the value falls


class AroundPaths(Planned):
    """Those of a plan, and a place to go round."""

    groups: ClassVar[Groups] = {"weights and limits": ("around",)}
    around: tuple[float, float, float] | None = Field(None, description=(
        "Place that the grasp keeps off [m]."))


@dataclass(frozen=True)
class Around(Constraint):
    """The grasp stays ``RADIUS`` off a place [m]."""

    place: tuple[float, float, float]
    limit: float = 1.0
    name = "nearness"

    def values(self, grasps, nodes):
        off = ((grasps - self.place) ** 2).sum(axis=1)
        return np.exp((RADIUS**2 - off) / SOFT**2)

    def tightened(self, factor):
        return replace(self, limit=self.limit / factor)


@pytest.fixture
def around():
    """It is known while a test runs."""
    def made(settings):
        place = getattr(settings, "around", None)
        return None if place is None else Around(place)
    CONSTRAINTS.append(made)
    yield
    CONSTRAINTS.remove(made)


@pytest.mark.slow
@pytest.mark.usefixtures("around", "coarse_bound")
def test_a_constraint_from_outside_is_kept(planned_branch, tmp_path):
    """A place on the free way: the motion goes round it on the full model, with a margin for the
    field's error; one where the branch hangs refuses every plan."""
    folder = shutil.copytree(planned_branch, tmp_path / "copy.branch")
    there = read_plan(folder / "plans/there.json")  # the free way
    rest, goal = there.motion.poses[0, :3], tuple(there.plan.poses[-1, :3])
    options = {"iterations": 100, "goal": goal, "inertia": False}

    def nearest(name, place):
        poses = read_plan(folder / f"plans/{name}.json").motion.poses[:, :3]
        return np.linalg.norm(poses - place, axis=1).min()

    place = tuple(map(float, there.plan.poses[len(there.plan.poses) // 2, :3]))
    assert nearest("there", place) < 1e-6
    done = AroundPaths(branch_folder=folder, **options, around=place, name="round").run()
    assert nearest("round", place) >= RADIUS
    assert done["margins"]["nearness"] > 0.0 and done["rounds"][-1]["broken"] == []
    with pytest.raises(NoPathError, match=r"rest pose: nearness 1\.\d+ exceeds the limit 1 "):
        AroundPaths(branch_folder=folder, **options, around=tuple(map(float, rest)),
                    name="no").run()
