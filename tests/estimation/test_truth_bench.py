"""How close estimates of the truth bench can come."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import drawn_branches
from benchmarks.mechanics_reduced import trained
from benchmarks.paper_branches import measured
from benchmarks.table import Setting
from benchmarks.trials import Budget
from benchmarks.truth import efficient
from benchmarks.worlds.plants import Plant
from limber.core.progress import SILENT
from limber.estimation.estimated_branch import forwards_of, parameter_space
from limber.estimation.fitting.objective import Objective
from limber.reduced.training import Snapshots


def test_moduli_that_err_together_count_as_one():
    """A tenth off all alike: the median of a normal's size is .67 of its deviation."""
    together = np.full((4, 4), 0.01) + 1e-12 * np.eye(4)
    assert abs(efficient(np.array([together, together])) - 0.068) < 0.004
    assert efficient(np.array([0.01 * np.eye(4)])) > 0.14
    nothing = np.full((4, 4), np.nan)
    assert efficient(np.array([together, nothing])) == efficient(np.array([together]))


@pytest.mark.slow
def test_a_known_form_leaves_less_open():
    """Of one drawn branch and pull; less of each modulus and of any mixture of them."""
    truth = drawn_branches.drawn_truth(np.random.default_rng(3))
    subject = drawn_branches.fitting_subject(truth)
    pull = measured(drawn_branches.exact_pull(
        truth, 0, drawn_branches.FIRST_PULL, drawn_branches.FIRST_TURN), 4)
    forwards = forwards_of([pull], subject, drawn_branches.SETTINGS)
    objective = Objective(forwards, parameter_space(subject, forwards, drawn_branches.SETTINGS))
    as_fitted, of_known_form = drawn_branches.bounds(truth, objective, subject)
    assert np.all(np.linalg.eigvalsh(as_fitted - of_known_form) > -1e-9)
    assert np.all(np.diag(of_known_form) < 0.8 * np.diag(as_fitted))


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


def test_training_goes_on_where_it_was_stopped(tmp_path):
    """With time for two of eight pieces a run, four runs take each once, in order."""
    taken, now = [], [0.0]

    def take(count, spread, rng, known):
        now[0] += 1.0
        taken.append((count, 0 if known is None else len(known), spread))
        return _snapshots(count)

    found = [trained(SimpleNamespace(take=take), Setting(
        7, True, Budget(2.5, clock=lambda: now[0]), SILENT, tmp_path)) for _ in range(4)]
    assert found[:3] == [None] * 3 and len(found[3]) == 160
    assert [count for _, count, _ in taken] == [20 * number for number in range(8)]
    assert [spread for *_, spread in taken] == 3 * [1.0] + 5 * [4.0]


def _snapshots(count: int) -> Snapshots:
    empty = np.zeros((count, 0, 2, 3))
    return Snapshots(np.zeros((count, 6)), np.ones((count, 4)), np.zeros((count, 2, 3)),
                     np.zeros(count), np.zeros((count, 3)), empty, empty, np.zeros((0, 2, 3)),
                     np.zeros(0, int), np.zeros((0, 2, 3)), np.zeros(0, int))
