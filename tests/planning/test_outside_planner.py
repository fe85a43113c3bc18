"""A planner from outside, by its entry point: planned with as with RRT*."""

import shutil
import sys

import numpy as np
import pytest
from tests.stages.specified import Planned
from tests.subjects.outside import forget, install

from limber.planning.planners.trees import chosen_engine

pytestmark = pytest.mark.usefixtures("rough_plan")


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_a_planner_from_outside_finds_the_baseline(planned_branch, tmp_path, monkeypatch):
    """Asked for the shortest and the gentle path, its line is the baseline, named as its own; auto
    prefers those that are there."""
    install(tmp_path / "site", monkeypatch)
    folder = shutil.copytree(planned_branch, tmp_path / "copy.branch")
    done = Planned(branch_folder=folder, name="line", engine="line", planner="d-rrt-star").run()
    shortest, gentle = sys.modules["outside.things"].Line.searched
    forget()
    assert shortest.weights.energy == 0.0 < gentle.weights.energy
    assert done["engine"] == "line" and chosen_engine("auto") in ("ompl", "own")
    straight = np.linalg.norm(np.subtract(done["goal"]["position_m"], done["start_m"]))
    assert done["baseline"]["length_m"] <= straight + done["goal"]["tolerance_m"]
    assert done["plan"]["energy_integral_jm"] <= 1.01 * done["baseline"]["energy_integral_jm"]
    assert (folder / "plans/line-trees.csv").read_text() == "planner,x_m,y_m,z_m,parent\n"
