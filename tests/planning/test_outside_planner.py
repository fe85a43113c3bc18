"""A planner from outside: one file, planned with as with RRT*."""

import shutil
from typing import Literal

import numpy as np
import pytest

from limber.planning.planners.rrt_star import Searched
from limber.planning.planners.trees import PLANNERS, chosen_engine
from limber.planning.settings import PlanSpec
from limber.stages.paths.plan import PlanPaths

pytestmark = pytest.mark.usefixtures("rough_plan")


class LinePaths(PlanSpec, PlanPaths):
    """Those of a plan, with one more planner."""

    engine: Literal["auto", "ompl", "own", "line"] = "line"


class Line:
    """The straight line to the goal; it grows no tree."""

    def __init__(self):
        self.searched = []

    def missing(self):
        return ""

    def search(self, problem, search, progress):
        self.searched.append(problem)
        return Searched(np.linspace(problem.start, problem.goals[0], 20))


@pytest.fixture
def line():
    PLANNERS["line"] = Line()
    yield PLANNERS["line"]
    del PLANNERS["line"]


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_a_planner_from_outside_finds_the_baseline(planned_branch, tmp_path, line):
    """Asked for the shortest and the gentle path, its line is the baseline, named as its own."""
    folder = shutil.copytree(planned_branch, tmp_path / "copy.branch")
    done = LinePaths(branch_folder=folder, name="line").run()
    shortest, gentle = line.searched
    assert shortest.weights.energy == 0.0 < gentle.weights.energy
    assert done["engine"] == "line"
    straight = np.linalg.norm(np.subtract(done["goal"]["position_m"], done["start_m"]))
    assert done["baseline"]["length_m"] <= straight + done["goal"]["tolerance_m"]
    assert done["plan"]["energy_integral_jm"] <= 1.01 * done["baseline"]["energy_integral_jm"]
    assert (folder / "plans/line-trees.csv").read_text() == "planner,x_m,y_m,z_m,parent\n"


def test_what_is_not_chosen_for_auto(line):
    """One from outside stands behind those that are there."""
    assert chosen_engine("auto") in ("ompl", "own")
    assert chosen_engine("line") == "line"
