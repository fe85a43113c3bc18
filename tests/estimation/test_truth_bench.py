"""How close estimates of the truth bench can come."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import truth_reduced
from benchmarks.budget import Budget
from benchmarks.paper_branches import measured
from benchmarks.table import Setting
from benchmarks.truth import _efficient
from benchmarks.truth_branch import drawn_truth, exact_pull
from benchmarks.truth_scans import ScanTrial, bending_row, width_row
from benchmarks.truth_trials import FIRST_PULL, FIRST_TURN, SETTINGS, bounds, fitting_subject
from benchmarks.worlds.plant import Plant
from limber.core.progress import SILENT
from limber.estimation.estimated_branch import forwards_of, parameter_space
from limber.estimation.fitting.objective import Objective
from limber.reduced.training import Snapshots


def test_moduli_that_err_together_count_as_one():
    """A tenth off all alike: the median of a normal's size is .67 of its deviation."""
    together = np.full((4, 4), 0.01) + 1e-12 * np.eye(4)
    assert abs(_efficient([together, together]) - 0.068) < 0.004
    assert _efficient([0.01 * np.eye(4)]) > 0.14
    nothing = np.full((4, 4), None)
    assert _efficient([together, nothing]) == _efficient([together])


@pytest.mark.slow
def test_a_known_form_leaves_less_open():
    """Of one drawn branch and pull; less of each modulus and of any mixture of them."""
    truth = drawn_truth(np.random.default_rng(3))
    subject = fitting_subject(truth)
    pull = measured(exact_pull(truth, 0, FIRST_PULL, FIRST_TURN), 4)
    forwards = forwards_of([pull], subject, SETTINGS)
    objective = Objective(forwards, parameter_space(subject, forwards, SETTINGS))
    as_fitted, of_known_form = bounds(truth, objective, subject)
    assert np.all(np.linalg.eigvalsh(as_fitted - of_known_form) > -1e-9)
    assert np.all(np.diag(of_known_form) < 0.8 * np.diag(as_fitted))


def _loop(view: str, noise: float, ratios: tuple[float, ...], refusal: str = "") -> ScanTrial:
    """Intervals of E I that are ``ratios`` times as wide as a bound of a tenth."""
    count = len(ratios)
    return ScanTrial((1, 3, 0), "monopodial", view, noise, count * (0.0,), count * (True,),
                     count * (0.3,), count * (True,), tuple(0.1 * each for each in ratios),
                     count * (0.0,), count * (0.1,), refusal, 1.0, "now")


def test_the_width_of_the_loops_is_that_of_their_fits():
    """Median 1.4 of five ratios; by view and noise; NaN: no bound; a refused loop has none."""
    loops = [_loop("round", 1e-3, (1.2, 1.4)), _loop("one-sided", 2e-3, (1.3, 2.0, 3.0)),
             _loop("round", 1e-3, (), "the scan is too sparse")]
    row = width_row(loops)
    assert row.met and row.count == 3
    assert row.measured == "1.40 (worst 3.0; round 1 mm 1.30; one-sided 2 mm 2.00)"
    assert width_row([_loop("round", 1e-3, (1.6, 1.7))]).met is False
    assert width_row(loops[2:]).measured == "no estimate"
    assert bending_row(loops).measured == (
        "100.0 % of 5 (median error 0 %, half width 14 %, of E 30 %)")


def test_a_branch_is_the_longest_axis_with_short_limbs():
    """Of an axis of 10 with a limb of 5 at 4, which forks after 1: the limb ends at a third of
    what is left, 2, and has no twig; the order of nodes stays."""
    axis = [[0, 0, z] for z in range(11)]
    limb = [[x, 0, 4] for x in range(1, 6)]
    parent = [*range(-1, 10), 4, 11, 12, 13, 14, 11, 16]
    plant = Plant(np.array([*axis, *limb, [1, 1, 4], [1, 2, 4]], float), np.array(parent),
                  np.r_[np.full(11, 0.3), np.full(5, 0.2), 0.1, 0.1])
    branch = plant.branch()
    assert np.array_equal(branch.nodes, [*axis, *limb[:2]])
    assert branch.parent.tolist() == [*range(-1, 10), 4, 11]
    assert branch.skeleton.arc_length.max() == 10


def test_training_goes_on_where_it_was_stopped(tmp_path, monkeypatch):
    """With time for two of eight pieces a run, four runs take each once, in order."""
    taken, now = [], [0.0]

    class Trainer:
        def take(self, poses, young, known):
            now[0] += 1.0
            taken.append((len(poses), 0 if known is None else len(known), float(np.ptp(young))))
            return _snapshots(len(poses))

    bench = SimpleNamespace(trainer=Trainer())
    monkeypatch.setattr(truth_reduced, "_grasps", lambda bench, count, spread, rng: (
        np.zeros((count, 6)), np.r_[np.ones((1, 4)), np.full((count - 1, 4), spread)]))

    def trained():
        budget = Budget(2.5, clock=lambda: now[0])
        return truth_reduced._trained(bench, Setting(7, True, budget, SILENT, tmp_path), "now")

    found = [trained() for _ in range(4)]
    assert found[:3] == [None] * 3 and len(found[3]) == 160
    assert [count for _, count, _ in taken] == [20 * number for number in range(8)]
    assert [spread for *_, spread in taken] == 3 * [0.0] + 5 * [3.0]


def _snapshots(count: int) -> Snapshots:
    empty = np.zeros((count, 0, 2, 3))
    return Snapshots(np.zeros((count, 6)), np.ones((count, 4)), np.zeros((count, 2, 3)),
                     np.zeros(count), np.zeros((count, 3)), empty, empty, np.zeros((0, 2, 3)),
                     np.zeros(0, int), np.zeros((0, 2, 3)), np.zeros(0, int))
