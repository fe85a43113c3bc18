"""The lower bound: below every path, close to the best, and its one assumption by brute force."""

from dataclasses import replace

import numpy as np
import pytest

from limber.core.errors import Cancelled, NoPathError
from limber.core.progress import Progress
from limber.planning.baseline_and_plan import plan_detour, plan_pair, with_bound
from limber.planning.certificate import lower_bound
from limber.planning.certificate.lower_bound import about_goal, certify, first_grid, refined
from limber.planning.constraints.limits import Limits
from limber.planning.cost import CostWeights, arc_lengths, path_cost, resample
from limber.planning.field.energy_field import knowing
from limber.planning.field.valid_region import TrustRegion
from limber.planning.goals.goal import GRASP, TIP, Goal, grasp_goal
from limber.planning.goals.region import Ball
from limber.planning.path_problem import GentleProblem
from limber.planning.planners import refine as refine_module
from limber.planning.planners.refine import (
    Excesses,
    plan_gentle,
    plan_gentle_all,
    refine,
    smooth_cost,
)
from limber.planning.settings import PlanSpec

START = np.array([-0.06, -0.03, 0.02])
GOAL = grasp_goal((0.1, 0.06, 0.02), 0.01)


def problem_on(field, *, start=START, goal=GOAL, deformation=1.0, **limits):
    weights = CostWeights.between(field, start, goal.centre(field), deformation=deformation,
                                  distance=1.5).weights
    limited = field.limited(**limits)  # the field taken for the branch
    return GentleProblem(field, limited, weights, start, goal, sure=limited)


@pytest.fixture(scope="module")
def across(ridge_field):
    """A path that has to get round the ridge, with its certificate."""
    problem = problem_on(ridge_field)
    return problem, plan_gentle(problem)


def bulges(problem, count):
    """Paths from start to goal that leave the line in random directions."""
    generator = np.random.default_rng(5)
    part = np.linspace(0.0, 1.0, 40)[:, None]
    end = problem.goal.centre(problem.energy_field)
    for _ in range(count):
        side = 0.05 * generator.normal(size=3)
        yield problem.start + part * (end - problem.start) + np.sin(np.pi * part) * side


def test_the_bound_from_anywhere_is_as_close_as_the_certificate(across):
    """On the finest grid that has a place: at the start the certificate's own, along the path never
    over what is left of its cost."""
    problem, found = across
    path = resample(found.points, 0.002)
    bound = found.certificate.to_go.at(path)
    left = found.cost - np.array([path_cost(path[:k + 1], problem.limits, problem.weights)
                                  for k in range(len(path))])
    assert bound[0] == pytest.approx(found.certificate.lower, rel=2e-3)
    assert (bound <= left + 2e-3 * found.cost).all()
    assert (bound >= left - 0.1 * found.cost).all()


def test_bound_is_below_and_plan_within_a_percent_of_an_independent_optimum(across):
    """Of many refined bulges none is below the bound, and the plan is as good as the best."""
    problem, found = across
    best = min(refine(path, problem)[1] for path in bulges(problem, 6))
    assert found.certificate.lower <= best
    assert found.cost <= 1.01 * best
    assert found.certificate.gap < 0.02
    assert found.cost == pytest.approx(found.certificate.upper)


@pytest.mark.slow
def test_gradient_of_the_subsolution_stays_below_the_cost_by_brute_force(across, monkeypatch):
    """At random points of open cells |grad u| <= c, with c from the field and not from the grid."""
    problem, found = across
    seen = []
    original = lower_bound.subsolution

    def kept(rates, known, shape, inside, **options):
        seen.append((rates, original(rates, known, shape, inside, **options), inside))
        return seen[-1][1]

    monkeypatch.setattr(lower_bound, "subsolution", kept)
    grids = []
    bound = lower_bound._bound
    monkeypatch.setattr(lower_bound, "_bound", lambda problem, on_grid, grid, cell: (
        grids.append(grid), bound(problem, on_grid, grid, cell))[1])
    certify(problem, lambda _path: found.cost)
    generator = np.random.default_rng(2)
    checked = 0
    for grid in grids:
        rates, u, inside = next(item for item in seen if item[1].shape == grid.open_cells.shape)
        cells = np.argwhere(rates.open_cells & ~inside)
        cells = cells[generator.integers(len(cells), size=3000)]
        place = generator.uniform(size=(len(cells), 3))
        slope = np.linalg.norm(_spline_slope(u, cells, place) / grid.edges, axis=1)
        points = grid.points(cells + place)
        rate = problem.weights.length + problem.weights.energy * problem.energy_field.energy(points)
        assert (slope <= rate * (1 + 1e-9)).all()
        assert (slope > 0.9 * rate).mean() > 0.3  # and not for being far below
        checked += len(cells)
    assert checked >= 6000


def test_cancelled_once_a_path_is_known_what_there_is_counts(across):
    """The bound of the grids so far, below the path; before any path a cancel ends it."""
    problem, found = across

    def cut(_fraction, _message, numbers):
        if "upper" in numbers:  # a number that is not finite is not told
            progress.cancel()

    progress = Progress(cut)
    early = certify(problem, lambda _path: found.cost, enough=0.0, progress=progress)
    assert early.stopped and len(early.levels) < len(found.certificate.levels) + 1
    assert 0.0 < early.lower <= found.certificate.lower < early.upper == found.cost
    with pytest.raises(Cancelled):
        certify(problem, lambda _path: found.cost, progress=progress)


def _spline_slope(u, cells, place):
    """Slopes [n, 3] of the quadratic B-spline per cell edge at ``place`` [n, 3] in ``cells``."""
    t = place[:, :, None]
    value = np.concatenate([(1 - t) ** 2 / 2, 0.5 + t - t**2, t**2 / 2], axis=2)
    slope = np.concatenate([t - 1, 1 - 2 * t, t], axis=2)
    block = np.stack([u[tuple(slice(k - 1, k + 2) for k in cell)] for cell in cells])
    return np.stack([np.einsum("nijk,ni,nj,nk->n", block, *[
        (slope if axis == component else value)[:, axis] for axis in range(3)])
        for component in range(3)], axis=1)


@pytest.mark.slow
def test_a_limit_along_the_branch_binds_path_and_bound(ridge_field, across):
    """The force along the branch stays below its limit; the bound stays below the dearer path."""
    _, free = across
    load = np.abs(ridge_field.load(resample(free.points, 0.001), "axial_force"))
    cap = 1.05 * max(load[0], load[-1])
    assert load.max() > 1.1 * cap
    problem = problem_on(ridge_field, axial_force=cap)
    found = plan_gentle(problem, enough=0.1)
    kept = np.abs(ridge_field.load(resample(found.points, 0.001), "axial_force"))
    assert kept.max() <= cap * (1 + 1e-9)
    assert found.cost > free.cost and found.certificate.lower <= found.cost


@pytest.mark.slow
def test_a_path_is_led_around_an_obstacle(ridge_field, across):
    """With a ball in the way of the free path: by the field it stays outside, for more cost."""
    _, free = across
    centre = free.points[len(free.points) // 2]

    def closeness(points):
        return np.exp((0.05**2 - ((points - centre)**2).sum(axis=1)) / 0.01)

    field = knowing(ridge_field, {"closeness": closeness(ridge_field.samples.positions)})
    assert np.abs(field.load(free.points, "closeness") - closeness(free.points)).max() < 0.2
    found = plan_gentle(problem_on(field, closeness=0.9), enough=0.1)
    fine = resample(found.points, 0.001)
    assert field.load(fine, "closeness").max() <= 0.9 * (1 + 1e-9)
    assert np.linalg.norm(fine - centre, axis=1).min() > 0.04
    assert found.certificate.lower <= found.cost and found.cost > free.cost


@pytest.mark.slow
def test_without_deformation_the_bound_is_the_distance(well_field):
    """Length alone: the best cost is the straight distance to the goal's face."""
    problem = problem_on(well_field, deformation=0.0)
    found = plan_gentle(problem)
    line = np.linalg.norm(GOAL.region.middle - START)
    best = 1.5 * (line - GOAL.tolerance) / line
    assert found.certificate.lower <= best * (1 + 1e-9)
    assert found.certificate.lower == pytest.approx(best, rel=0.01)
    assert found.cost == pytest.approx(best, rel=0.002)


@pytest.mark.slow
def test_from_the_rest_pose_and_for_the_tip(ridge_field):
    """A bound holds for a goal of the tip too, and is close."""
    wanted = ridge_field.tip(GOAL.region.middle[None])[0]
    problem = problem_on(ridge_field, start=ridge_field.rest.copy(),
                         goal=Goal(TIP, Ball(tuple(wanted), 0.015)))
    found = plan_gentle(problem, enough=0.05)
    best = min(refine(path, problem)[1] for path in bulges(problem, 4))
    assert found.certificate.lower <= min(best, found.cost) * (1 + 1e-9)
    assert found.cost <= 1.01 * best
    assert found.certificate.gap < 0.05


@pytest.mark.slow
def test_field_error_lowers_the_bound(across):
    """What the energy may be wrong by is taken off the bound, about its share of the cost: each
    bound is within what is enough."""
    problem, found = across
    unsure = plan_gentle(replace(problem, field_error=0.02))
    length = np.linalg.norm(np.diff(found.points, axis=0), axis=1).sum()
    off = 0.02 * problem.weights.energy * length
    assert found.certificate.lower - unsure.certificate.lower == pytest.approx(
        off, abs=lower_bound.ENOUGH * found.cost)
    assert off > 1.5 * lower_bound.ENOUGH * found.cost


@pytest.mark.slow
def test_no_path_is_proven_where_a_limit_separates(well_field):
    """A wall of refused poses between start and goal: that there is no path is proven, and said."""
    start, goal = np.array([-0.12, 0.0, 0.0]), grasp_goal((0.12, 0.0, 0.0), 0.01)
    accepted = well_field.samples.positions
    accepted = accepted[np.abs(accepted[:, 0]) > 0.05]
    walled = replace(well_field, region=TrustRegion.of(accepted, _wall()))
    with pytest.raises(NoPathError, match=r"No path exists.*proven on a grid"):
        plan_gentle(problem_on(walled, start=start, goal=goal))


@pytest.mark.slow
@pytest.mark.parametrize("wrong_grids", [1, 5])
def test_a_grid_too_coarse_for_a_valley_proves_nothing(well_field, monkeypatch, wrong_grids):
    """The next grid is asked; and a path that keeps the limits is a better proof than any."""
    problem, spacings, bound = problem_on(well_field), [], lower_bound._bound

    def blind(problem, on_grid, grid, cell):
        spacings.append(grid.spacing)
        if len(spacings) <= wrong_grids:
            raise NoPathError("No path exists", "Proven on a grid")
        return bound(problem, on_grid, grid, cell)

    monkeypatch.setattr(lower_bound, "_bound", blind)
    found = plan_gentle(problem)
    assert found.cost == problem.cost(found.points) < np.inf
    assert spacings[1] < 0.4 * spacings[0]
    assert (found.certificate.lower > 0.0) == (wrong_grids == 1)
    assert found.certificate.levels


def _wall():
    """Refused poses in a layer across x = 0."""
    y, z = np.meshgrid(np.arange(-0.25, 0.26, 0.02), np.arange(-0.25, 0.26, 0.02))
    return np.stack([0 * y, y, z], axis=-1).reshape(-1, 3)


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_refined_path_keeps_limits_and_runs_along_them(ridge_field):
    """With a limit on force that binds, the refined path keeps it and gets close to it."""
    free = plan_gentle(problem_on(ridge_field))
    force = np.linalg.norm(ridge_field.force(free.points), axis=1)
    ends = max(force[0], force[-1])
    limit = max(0.93 * force.max(), 1.02 * ends)
    held = plan_gentle(problem_on(ridge_field, max_force=limit))
    kept = np.linalg.norm(ridge_field.force(held.points), axis=1)
    assert kept.max() <= limit
    assert held.cost >= free.cost * (1 - 1e-6)
    assert held.certificate.lower <= held.cost


def test_one_refinement_brings_the_end_to_the_goals_face(well_field):
    """From the straight line to the goal's middle: the minimiser's first step must not be so long
    that it gives up."""
    problem = problem_on(well_field, deformation=0.0)
    path, cost = refine(np.linspace(START, GOAL.region.centre, 40), problem)
    line = np.linalg.norm(GOAL.region.middle - START)
    assert cost == pytest.approx(1.5 * (line - GOAL.tolerance) / line, rel=0.001)
    assert -1e-4 < problem.goal_excess(path[-1]) <= 0.0


def test_the_next_grid_is_as_fine_as_the_gap_asks_and_holds_what_was_kept(well_field):
    """Cells of any share of the edge: the start in the centre of one, every kept cell covered, and
    closed layers about them."""
    grid, cell = first_grid(problem_on(well_field))
    keep = np.zeros(grid.open_cells.shape, bool)
    keep[tuple(cell)] = keep[tuple(cell + [1, 0, 0])] = keep[tuple(cell + [1, 1, 2])] = True
    generator = np.random.default_rng(0)
    inside = np.argwhere(keep)[generator.integers(3, size=300)] + generator.uniform(size=(300, 3))
    points = grid.points(inside)
    for ratio in (1.0 / 3.0, 0.47, 0.75, np.array([1.0, 0.6, 1.0 / 3.0])):
        finer, own = refined(grid, keep, keep, cell, ratio)
        assert np.allclose(finer.edges, ratio * grid.edges)
        assert np.allclose(finer.points(own[None] + 0.5), START)
        numbers = np.floor((points - finer.origin) @ finer.axes.T / finer.edges).astype(int)
        assert finer.open_cells[tuple(numbers.T)].all()
        edge = np.ones(finer.open_cells.shape, bool)
        edge[3:-3, 3:-3, 3:-3] = False
        assert not finer.open_cells[edge].any()
    exact = refined(grid, keep, keep, cell)[0]
    assert exact.open_cells.sum() == 27 * keep.sum()


def test_a_path_far_over_a_limit_is_given_up_soon(ridge_field, monkeypatch):
    """A goal that takes a thousand times the force: three rounds, none of them again with more
    margin, and the path is what it was."""
    rounds, settle = [], refine_module._Line.settle
    monkeypatch.setattr(refine_module._Line, "settle", lambda *given: (
        rounds.append(1), settle(*given))[1])
    problem = problem_on(ridge_field, max_force=1e-3)
    line = np.linspace(START, GOAL.region.centre, 40)
    path, cost = refine(line, problem)
    assert cost == np.inf and path is line and len(rounds) <= 3


def test_gradients_of_cost_and_penalty_are_those_of_differences(ridge_field):
    """Analytic gradients agree with central differences, limits broken and goal missed; also with
    multipliers."""
    problem = replace(problem_on(ridge_field), longest=0.1, limits=Limits(
        energy=0.02, force=0.5).on(ridge_field, 1.0))
    path = next(bulges(problem, 1))[::4] * 1.6
    path[-1] += 0.05
    direction = np.random.default_rng(0).normal(size=path.shape)
    step = 1e-6

    limits = Excesses(problem, 1e-3)

    def both(points):
        value, slope = smooth_cost(points, problem.energy_field, problem.weights)
        broken, push = limits.penalty(points)
        return value + broken, slope + push

    for _ in range(2):
        ahead, behind = both(path + step * direction)[0], both(path - step * direction)[0]
        assert limits.penalty(path)[0] > 0.01
        assert (both(path)[1] * direction).sum() == pytest.approx((ahead - behind) / (2 * step),
                                                                  rel=1e-3)
        assert limits.push(path) > 0.1


def test_a_path_that_shrinks_to_nothing_is_refined(ridge_field):
    """A start a nanometre before the goal: the path has fewer corners with each round."""
    goal = grasp_goal((0.1, 0.06, 0.02), 0.01)
    start = goal.region.middle - [goal.tolerance + 1e-9, 0.0, 0.0]
    problem = problem_on(ridge_field, start=start, goal=goal, max_energy=2.0)
    path, cost = refine(start + np.linspace(0.0, 1.0, 20)[:, None] * [0.005, 0.0, 0.0], problem)
    assert np.isfinite(cost) and np.linalg.norm(path[-1] - path[0]) < 1e-3


def test_a_bound_is_for_all_of_the_goal_where_paths_end_deeper_in_it(well_field, monkeypatch):
    """A plan that keeps off the goal's border is held against paths that end on it: the bound is
    the one of the goal that was requested."""
    monkeypatch.setattr(lower_bound, "_LEVELS", 2)
    whole = Goal(TIP, Ball((0.15, 0.09, 0.33), 0.02))
    inner = replace(whole, inset=0.01)
    asked, drawn_in, mixed = (problem_on(well_field, goal=goal) for goal in (whole, inner, inner))
    mixed = replace(mixed, asked_goal=whole, weights=asked.weights)
    drawn_in = replace(drawn_in, weights=asked.weights)
    lower = [certify(one, lambda _: np.inf).lower for one in (asked, mixed, drawn_in)]
    assert lower[1] == pytest.approx(lower[0], rel=0.02)
    assert lower[2] > 1.002 * lower[1] > 0.0


@pytest.mark.slow
def test_no_point_of_a_targets_goal_costs_more_than_nothing(well_field):
    """By brute force, on three grids: its cell has all its coefficients, and the spline of the cost
    left is at most 0. The target moves farther than the grasp, at another rate at each place."""
    goal = Goal(TIP, Ball((0.15, 0.09, 0.33), 0.02))
    problem = problem_on(well_field, goal=goal)
    points = goal.guess(well_field, 4000, np.random.default_rng(3))
    points = points[well_field.region.contains(points)
                    & (goal.excess(well_field, points) <= 0.0)]
    assert len(points) > 100
    grid, cell = first_grid(problem)
    for _ in range(3):
        rates = lower_bound._terrain(problem, lower_bound._field_on_grid(problem, grid, cell), grid)
        goal_cells = about_goal(problem, grid, rates)
        costs = lower_bound.subsolution(rates, goal_cells.known, goal_cells.cost, goal_cells.inside)
        spot = (points - grid.origin) @ grid.axes.T / grid.edges
        number = np.floor(spot).astype(int)
        is_open = rates.open_cells[tuple(number.T)]
        assert is_open.mean() > 0.5
        number, t = number[is_open], (spot - number)[is_open]
        weights = np.stack([0.5 * (1 - t)**2, 0.5 + t - t**2, 0.5 * t**2])
        value = np.zeros(len(t))
        for offset in np.ndindex(3, 3, 3):
            where = tuple((number + offset - 1).T)
            assert goal_cells.known[where].all()
            value += costs[where] * np.prod([
                weights[step, :, axis] for axis, step in enumerate(offset)], axis=0)
        assert value.max() <= 0.0
        grid, cell = refined(grid, rates.open_cells, goal_cells.near, cell, 0.6)


def test_a_cost_is_lowered_for_its_curvature_beside_the_border():
    """A cost that bends in the cell next to the border bends the spline in the border's as well:
    all coefficients of its spline are lowered."""
    border, costs = np.zeros((9, 9, 9), bool), np.zeros((9, 9, 9))
    border[4, 4, 4], costs[6:] = True, 1.0
    lowered = lower_bound._bent_up(costs, border)
    assert lowered[3:6, 3:6, 3:6] == pytest.approx(lower_bound.CURVATURE_FACTOR / 8.0)


class Jump(Goal):
    """A goal whose distance grows six times as fast in a layer far from it as near it."""

    def excess(self, field, points):
        away = super().excess(field, points) + self.tolerance
        return away * (1.0 + 1.0 / (1.0 + np.exp(-(away - 0.08) / 0.004))) - self.tolerance


def test_where_the_target_moves_fast_far_from_the_goal_nothing_counts_as_near_it(well_field):
    """As at a snap of the branch: cells there were sources of the bound, of hardly any cost."""
    problem = problem_on(well_field, goal=Jump(GRASP, Ball((0.1, 0.06, 0.02), 0.01)))
    grid, cell = first_grid(problem)
    grid, cell = refined(grid, grid.open_cells, grid.about_goal, cell, 0.5)
    rates = lower_bound._terrain(problem, lower_bound._field_on_grid(problem, grid, cell), grid)
    known = grid.points(np.argwhere(about_goal(problem, grid, rates).known) + 0.5)
    away = np.linalg.norm(known - problem.goal.region.centre, axis=1)
    assert 0.01 < away.max() < 0.05


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_a_plan_is_bounded_closely_once_it_holds(ridge_field):
    """Before, any bound will do; afterwards the same path has one as close as if asked at once."""
    settings = PlanSpec(iterations=300, engine="own")
    at_once = plan_pair(ridge_field, START, GOAL, settings)
    before = plan_pair(ridge_field, START, GOAL, settings, is_bounded=False)
    after = with_bound(before)
    assert len(before.certificate.levels) == 1 < len(after.certificate.levels)
    assert before.certificate.lower < after.certificate.lower
    assert after.certificate.lower == pytest.approx(at_once.certificate.lower, rel=0.02)
    assert np.array_equal(before.plan.points, after.plan.points)
    assert with_bound(after) is after


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_a_detour_may_count_from_the_tree(ridge_field):
    """As in the paper's table: the path of RRT* as its tree has it is longer than the shortest."""
    settings = PlanSpec(iterations=300, engine="own", max_detour=2.0)
    shortest, tree = (plan_pair(ridge_field, START, GOAL, settings, is_compared=from_tree)
                      for from_tree in (False, True))
    raw = arc_lengths(resample(tree.compared["RRT*, not smoothed"], 0.005))[-1]
    assert tree.detour.longest == pytest.approx(1.02 * raw)
    assert tree.detour.longest > 1.01 * shortest.detour.longest
    assert tree.detour.energy_integral < shortest.detour.energy_integral


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_costs_of_two_seeds_compare(ridge_field):
    """Scales and the plan's cost do not depend on the seed; D-RRT* is never below the bound."""
    found = [plan_pair(ridge_field, START, GOAL, PlanSpec(
        seed=seed, iterations=300, engine="own", planner=planner))
        for seed, planner in ((0, "eikonal"), (1, "d-rrt-star"))]
    assert found[0].cost == found[1].cost
    first, second = (pair.certificate for pair in found)
    assert first.lower == pytest.approx(second.lower, rel=0.01)
    assert first.upper <= second.upper * (1 + 1e-6)
    assert max(first.lower, second.lower) <= first.upper
    assert set(found[1].compared) == {"straight line", "eikonal", "RRT*", "RRT*, not smoothed",
                                      "D-RRT*", "D-RRT*, not smoothed"}


def test_bounds_together_are_those_of_each_alone_and_ask_the_field_once(ridge_field, monkeypatch):
    """Two weights of length on common grids: each bound is below its path, as close as was asked,
    and no corner is evaluated twice on a grid."""
    one = problem_on(ridge_field)
    two = replace(one, weights=one.weights._replace(length=4.0 * one.weights.length))
    asked, grids, on_grid = [], [], lower_bound._field_on_grid
    energy = type(ridge_field).energy
    monkeypatch.setattr(type(ridge_field), "energy", lambda self, points: (
        asked.append(len(points)), energy(self, points))[1])

    def counted(problem, grid, cell):
        asked.clear()
        found = on_grid(problem, grid, cell)
        grids.append((asked[:], len(found.corners)))
        return found
    monkeypatch.setattr(lower_bound, "_field_on_grid", counted)
    together = plan_gentle_all([one, two], enough=[0.05, 0.05])
    count = len(grids)
    assert count >= 2 and all(numbers == [corners] for numbers, corners in grids)
    for problem, found in zip((one, two), together, strict=True):
        alone = plan_gentle(problem, enough=0.05)
        assert 0.0 < found.certificate.lower <= found.cost <= 1.05 * found.certificate.lower
        assert found.cost == pytest.approx(alone.cost, rel=0.01)
        assert found.certificate.lower <= alone.cost and alone.certificate.lower <= found.cost


def test_cells_are_flat_where_energy_bends_off_a_shell(well_field):
    """Ten times the bends along the last axis: it is cut more, up to the largest ratio of edges,
    and bends shrink as a common ratio would make them."""
    grid, cell = first_grid(problem_on(well_field))
    rates = lower_bound._terrain(problem_on(well_field), lower_bound._field_on_grid(
        problem_on(well_field), grid, cell), grid)
    bends = np.ones_like(rates.bends) * np.array([1.0, 1.0, 10.0]).reshape(3, 1, 1, 1)
    ratios = lower_bound._ratios(rates._replace(bends=bends), rates.open_cells, 0.7)
    assert ratios[0] == ratios[1] > 2.0 * ratios[2]
    assert (ratios**2 * [1.0, 1.0, 10.0]).sum() <= 0.7**2 * 12.0 * (1 + 1e-9)
    flat = lower_bound._ratios(rates._replace(bends=bends**4), rates.open_cells, 0.34)
    edges = flat * grid.edges
    assert edges.max() / edges.min() <= 4.0 + 1e-9


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_detour_limit_holds_and_its_bound_is_below(ridge_field):
    """Within 3 % of the shortest length: kept, dearer than without, and no bulge that is as short
    has less energy than the dual's bound says."""
    problem = problem_on(ridge_field)
    shortest, _ = refine(np.linspace(START, GOAL.region.centre, 40), replace(
        problem, weights=problem.weights._replace(energy=0.0)))
    free = plan_gentle(problem)
    held = plan_detour(problem, shortest, 1.03 * arc_lengths(shortest)[-1], [free.points])
    length = np.linalg.norm(np.diff(held.found.points, axis=0), axis=1).sum()
    assert length <= 1.03 * held.shortest * (1 + 1e-9)
    assert length > 1.01 * held.shortest, "the detour that is allowed is of use here"
    assert held.energy_bound <= held.energy_integral
    assert held.energy_integral <= 1.1 * held.energy_bound
    curve = sorted(held.curve, key=lambda point: point.weight)
    assert curve[0].length_m >= curve[-1].length_m
    assert curve[0].energy_integral_jm <= curve[-1].energy_integral_jm
    lines = [point for point in held.curve if point.lower_bound_jm is not None]
    assert len(lines) >= 3, "a band needs bounds at several weights"
    for path in [*bulges(problem, 40), held.found.points]:
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        if length <= held.longest:
            middles = (path[1:] + path[:-1]) / 2
            pieces = np.linalg.norm(np.diff(path, axis=0), axis=1)
            energy = ridge_field.energy(middles) @ pieces * (1 + 1e-4)
            assert energy >= held.energy_bound
            assert all(energy >= one.lower_bound_jm - one.metre_jm * length for one in lines)


def test_no_path_short_enough_leaves_the_cells_that_count(well_field):
    """Every point that is reached and left within the length lies in an open cell; far cells are
    closed."""
    line = np.linalg.norm(GOAL.region.middle - START)
    problem = replace(problem_on(well_field), longest=1.1 * line)
    grid, cell = first_grid(problem)
    numbers = np.argwhere(grid.open_cells)
    centres = grid.points(numbers + 0.5)
    near = np.zeros(grid.open_cells.shape, bool)
    near[tuple(numbers.T)] = np.linalg.norm(centres - GOAL.region.centre, axis=1) <= (
        GOAL.tolerance + grid.spacing)
    found = lower_bound.short_enough(problem, grid, grid.open_cells, near, cell)
    points = grid.points(numbers + np.random.default_rng(0).uniform(size=numbers.shape))
    through = np.linalg.norm(points - START, axis=1) + np.maximum(
        np.linalg.norm(points - GOAL.region.centre, axis=1) - GOAL.tolerance, 0.0)
    short = through <= problem.longest
    assert short.sum() > 50 and found[tuple(numbers[short].T)].all()
    assert found.sum() < 0.7 * grid.open_cells.sum()


@pytest.mark.slow
def test_a_length_is_kept_as_a_limit(ridge_field):
    """From the path round the ridge: just as long as allowed, and gentler than the shortest."""
    problem = problem_on(ridge_field)
    line = np.linspace(START, GOAL.region.centre, 40)
    shortest, _ = refine(line, replace(problem, weights=problem.weights._replace(energy=0.0)))
    longest = 1.02 * np.linalg.norm(np.diff(shortest, axis=0), axis=1).sum()
    limited = replace(problem, longest=longest, weights=problem.weights._replace(
        length=0.01 * problem.weights.length))
    found, cost = refine(plan_gentle(problem).points, limited)
    length = np.linalg.norm(np.diff(found, axis=0), axis=1).sum()
    assert np.isfinite(cost) and 0.995 * longest < length <= longest * (1 + 1e-9)
    assert cost < limited.cost(shortest)
    assert limited.cost(line + 0.05 * np.sin(np.linspace(0, np.pi, 40))[:, None]) == np.inf
