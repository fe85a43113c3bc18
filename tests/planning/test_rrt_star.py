"""Both engines of RRT* on a branch with a ridge: gentler, honest when there is no way."""

import csv
import shutil
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from limber.core.errors import Cancelled, InputError, NoPathError
from limber.core.progress import Progress
from limber.planning.baseline_and_plan import _shortest_known
from limber.planning.compared_planners import BASELINE, COMPARED, run_trials, summarised
from limber.planning.constraints.limits import Limits
from limber.planning.cost import STEP, CostWeights, EdgeWeights, arc_lengths, measure_path
from limber.planning.goals.goal import TIP, Goal, goal_points, grasp_goal
from limber.planning.goals.goal_kinds import default_goal
from limber.planning.goals.region import Ball
from limber.planning.path_problem import GentleProblem
from limber.planning.planners.rrt_star import PathProblem, Search
from limber.planning.planners.trees import FoundPath, OmplRrtStar, plan_path
from limber.planning.settings import PlanSpec
from limber.stages.paths.compare import ComparePlanners
from limber.stages.registry import stage_class

START = np.array([-0.13, 0.0, 0.0])
GOAL = grasp_goal((0.13, 0.0, 0.0), 0.01)
ENGINES = ["own", pytest.param("ompl", marks=pytest.mark.skipif(
    bool(OmplRrtStar().missing()), reason=f"OMPL: {OmplRrtStar().missing()}"))]


def make_problem(field, *, deformation, distance=0.3, goal=GOAL, **limits):
    limited = field.limited(**limits)
    cost = CostWeights.between(field, START, goal.centre(field),
                               deformation=deformation, distance=distance)
    return PathProblem(field, limited, cost.weights, START, goal,
                       goals=goal_points(goal, field, limited))


def measured(field, points):
    return measure_path(points, field.energy(points), np.linalg.norm(field.force(points), axis=1))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_deformation_aware_path_goes_round_the_ridge(ridge_field, engine):
    """D-RRT* saves at least 40 % of the energy of the baseline for at most 25 % more length."""
    search = Search(iterations=1500, seed=1)
    baseline = plan_path(make_problem(ridge_field, deformation=0.0, distance=1.0), search,
                         engine=engine)
    gentle = plan_path(make_problem(ridge_field, deformation=1.0), search, engine=engine)
    first, second = measured(ridge_field, baseline.points), measured(ridge_field, gentle.points)
    assert second.energy_integral_jm < 0.6 * first.energy_integral_jm
    assert second.peak_energy_j < 0.6 * first.peak_energy_j
    assert first.length_m < second.length_m < 1.25 * first.length_m
    for found in (baseline, gentle):
        assert np.allclose(found.points[0], START)
        assert GOAL.excess(ridge_field, found.points[-1:])[0] <= 1e-9
        assert ridge_field.region.contains(found.points).all()
        assert found.cost <= found.tree_cost + 1e-9


@pytest.mark.parametrize("engine", ENGINES)
def test_baseline_is_the_straight_line(well_field, engine):
    """Without deformation in its cost RRT* ends within 2 % of the straight distance."""
    found = plan_path(make_problem(well_field, deformation=0.0, distance=1.0),
                      Search(iterations=800, seed=2), engine=engine)
    straight = np.linalg.norm(found.points[-1] - found.points[0])
    assert measured(well_field, found.points).length_m < 1.02 * straight


def test_no_plan_is_shorter_than_the_shortest_path(well_field):
    """RRT*'s path has the error of its samples; the two paths, shortened, do not."""
    problem = GentleProblem(well_field, Limits().on(well_field), EdgeWeights(0.0, 1.0, STEP),
                            START, GOAL)
    end = np.array([0.122, 0.0, 0.0])
    tree, plan = (FoundPath(np.array([START, [0.0, aside, 0.0], end]), 1.0, 1.0, [{"cost": aside}])
                  for aside in (0.03, 0.02))
    for one, other in ((tree, plan), (plan, tree), (None, plan)):
        found = _shortest_known(problem, one, other)
        assert arc_lengths(found.points)[-1] < 1.01 * (0.26 - GOAL.tolerance)
        assert found.history == (one or other).history


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_seed_decides_the_path(ridge_field, engine):
    """The same seed gives the same path to the bit; another seed another tree."""
    problem = make_problem(ridge_field, deformation=1.0)
    one, two, other = (plan_path(problem, Search(iterations=600, seed=seed), engine=engine)
                       for seed in (5, 5, 6))
    assert np.array_equal(one.points, two.points)
    assert one.history == two.history
    assert other.tree_cost != one.tree_cost


@pytest.mark.parametrize("engine", ENGINES)
def test_cost_falls_as_the_tree_grows(ridge_field, engine):
    """The history of the best cost never rises."""
    found = plan_path(make_problem(ridge_field, deformation=1.0),
                      Search(iterations=2000, seed=3), engine=engine)
    costs = [entry["cost"] for entry in found.history]
    assert len(costs) > 3 and (np.diff(costs) <= 1e-9).all()
    assert costs[-1] == pytest.approx(found.tree_cost, rel=1e-3)


@pytest.mark.slow
def test_limit_is_kept_all_along(ridge_field):
    """With a cap on energy even the shortest path stays below it, going round."""
    cap = 0.15
    found = plan_path(make_problem(ridge_field, deformation=0.0, distance=1.0, max_energy=cap),
                      Search(iterations=2500, seed=4))
    dense = np.concatenate([np.linspace(a, b, 20) for a, b in
                            zip(found.points[:-1], found.points[1:], strict=True)])
    assert ridge_field.energy(dense).max() < 1.02 * cap
    force_cap = 3.0
    found = plan_path(make_problem(ridge_field, deformation=0.0, distance=1.0,
                                   max_force=force_cap), Search(iterations=2500, seed=4))
    assert np.linalg.norm(ridge_field.force(found.points), axis=1).max() < 1.02 * force_cap


def test_goal_behind_a_wall(ridge_field):
    """A cap that parts the start from the goal ends in NoPathError and not in a path."""
    problem = make_problem(ridge_field, deformation=0.0, distance=1.0)
    wall = np.random.default_rng(0).uniform([-0.03, -0.2, -0.2], [0.03, 0.2, 0.2], (2000, 3))
    start_and_goal_only = replace(ridge_field.limited(max_energy=1.0),
                                  region=replace(ridge_field.region, rejected=wall).numbers)
    walled = replace(problem, limits=start_and_goal_only)
    with pytest.raises(NoPathError, match="500 iterations"):
        plan_path(walled, Search(iterations=500))


def test_tip_goal_brings_the_tip_there(ridge_field):
    """Grasp positions for a tip goal put the tip, by the field, within the tolerance."""
    goal = Goal(TIP, Ball((0.15, -0.05, 0.33), 0.01))
    points = goal_points(goal, ridge_field, ridge_field.limited())
    assert len(points) > 20
    assert np.linalg.norm(ridge_field.tip(points) - goal.region.centre, axis=1).max() <= 0.01
    found = plan_path(make_problem(ridge_field, deformation=1.0, goal=goal),
                      Search(iterations=800, seed=1))
    assert goal.excess(ridge_field, found.points[-1:])[0] <= 1e-9


def test_default_goal_is_far_and_reachable(ridge_field):
    """The default goal is deflected far, trusted, and gentle among the far poses."""
    goal = default_goal(ridge_field, 0.01)
    away = np.linalg.norm(goal.region.middle - ridge_field.rest)
    assert away > 0.6 * 0.2
    assert ridge_field.region.contains(goal.region.middle)[0]
    far = np.linalg.norm(ridge_field.samples.positions, axis=1) > 0.15
    at_goal = ridge_field.energy(goal.region.middle)[0]
    assert at_goal < np.median(ridge_field.samples.energies[far])
    # On a seedling a tolerance for branches would take in the start.
    assert default_goal(ridge_field, 1.0).excess(ridge_field, ridge_field.rest[None])[0] > 0.0


@pytest.mark.parametrize("engine", ENGINES)
def test_cancel_ends_the_search(ridge_field, engine):
    """A cancel during the search raises Cancelled out of either engine."""
    progress = Progress(lambda fraction, _message, _numbers:
                        progress.cancel() if fraction > 0.1 else None)
    with pytest.raises(Cancelled):
        plan_path(make_problem(ridge_field, deformation=1.0), Search(iterations=4000),
                  engine=engine, progress=progress)


@pytest.mark.parametrize("engine", ENGINES)
def test_the_tree_comes_with_the_path(ridge_field, engine):
    """Each node hangs on one before it, all on the start; the tree's polyline runs along edges; a
    smaller tree has the same edges."""
    problem = make_problem(ridge_field, deformation=1.0)
    found = plan_path(problem, Search(iterations=600, seed=5), engine=engine)
    nodes, parents = found.tree.nodes, found.tree.parents
    assert parents[0] == -1 and np.array_equal(nodes[0], START) and len(nodes) > 100
    assert ((parents[1:] >= 0) & (parents[1:] < np.arange(1, len(nodes)))).all()

    def edges(tree):
        return {(*tree.nodes[parent], *tree.nodes[node])
                for node, parent in enumerate(tree.parents) if parent >= 0}

    assert {(*a, *b) for a, b in pairwise(found.raw)} <= edges(found.tree)
    small = found.tree.pruned(50)
    assert len(small.nodes) == 50 and len(edges(small)) == 49
    assert edges(small) < edges(found.tree)


# The paper's experiment: planners over random starts, its table and its figure.

SETTINGS = PlanSpec(iterations=300, engine="own", seed=3)


@pytest.fixture(scope="module")
def trials(ridge_field):
    return run_trials(ridge_field, grasp_goal((0.1, 0.06, 0.02), 0.02), SETTINGS, 3)


def test_trials_start_elsewhere_and_are_scored_alike(trials, ridge_field):
    """Each start is another; scores are of the paths; the gentle one costs least energy."""
    starts = np.array([trial.start for trial in trials])
    assert np.linalg.norm(np.diff(starts, axis=0), axis=1).min() > 0.01
    for trial in trials:
        assert set(trial.paths) == set(COMPARED) and trial.gap_percent < 5.0
        for name, path in trial.paths.items():
            assert np.allclose(path[0], trial.start)
            length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
            assert trial.scores[name].length_m == pytest.approx(length)
            assert trial.scores[name].peak_energy_j == ridge_field.energy(path).max()
    energy = [sum(trial.scores[name].energy_integral_jm for trial in trials)
              for name in ("eikonal", BASELINE)]
    assert energy[0] < energy[1]


def test_the_table_has_means_deviations_and_changes(trials):
    """Against the mean of RRT* as its tree has it; a planner without a path in a trial counts in
    the others alone."""
    found = summarised(trials)
    lengths = np.array([trial.scores["eikonal"].length_m for trial in trials])
    base = np.array([trial.scores[BASELINE].length_m for trial in trials])
    gentle = found["eikonal"]
    assert gentle["length_m_mean"] == pytest.approx(lengths.mean())
    assert gentle["length_m_deviation"] == pytest.approx(lengths.std(ddof=1))
    assert gentle["longer_percent"] == pytest.approx(100 * (lengths.mean() / base.mean() - 1))
    assert found[BASELINE]["saved_percent"] == 0.0
    less = [*trials[:2], type(trials[2])(2, trials[2].start, {}, {}, trouble="none")]
    assert summarised(less)["eikonal"]["trials"] == 2


@pytest.mark.slow  # a plan on a branch's field
def test_the_command_writes_table_and_figure(planned_branch, tmp_path, monkeypatch):
    folder = shutil.copytree(planned_branch, tmp_path / "copy.branch")
    settings = {"trials": 1, "seed": 3}
    result = ComparePlanners(branch_folder=folder, **settings).run(Progress(on_warning=pytest.fail))
    with (folder / "comparisons/planners.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["planner"] for row in rows] == list(COMPARED.values())
    assert (folder / "comparisons/planners.png").stat().st_size > 10_000
    (title, table), = stage_class("compare").about.result.of(result).tables()
    assert "1 random starts" in title and len(table) == 1 + len(COMPARED)
    assert table[1][0] == "copy" and table[1][3] == "" and float(table[5][5]) != 0.0
    monkeypatch.setattr("limber.planning.compared_planners.run_trials", pytest.fail)
    assert ComparePlanners(branch_folder=folder, **settings).run() == result, "it is current"
    with pytest.raises(InputError, match="cannot name"):
        ComparePlanners(branch_folder=folder, **settings, name="../there").run()
