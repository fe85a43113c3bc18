"""What a refusal advises, followed, ends in moduli whose intervals hold, or in another refusal.

The markers are 11 mm off their control points along the branch, as where a scan's tip is short.
"""

from dataclasses import replace

import numpy as np
import pytest
from tests.estimation.test_nuisances import TRUTH, subject_of

from benchmarks.paper_branches import FRACTIONS, measured
from limber.core.errors import LimberError
from limber.estimation.fit import fit_branch
from limber.estimation.fit_assessment import judge_model, require_result
from limber.estimation.fitting.objective import EvaluationLog
from limber.estimation.settings import FitSpec
from limber.estimation.simulated_pull import marked_points
from limber.estimation.uncertainty.model_error import total_interval
from limber.recordings.recording import CalibrationEntry

OFF_M = 11e-3


@pytest.fixture(scope="module")
def off(small, small_pull):
    """The pull with places of its markers that are 11 mm short of where they are."""
    pull = measured(small_pull, 5, points=5e-4, force=0.01)
    peak = float(np.linalg.norm(small_pull.wrenches[:, :3], axis=1).max())
    places = marked_points(small.skeleton, FRACTIONS, -OFF_M)
    return replace(pull, entry=pull.entry.model_copy(update={
        "rest_points_m": tuple(map(tuple, places.tolist())),
        "calibration": CalibrationEntry(force_bias_sigma_n=0.05 * peak,
                                        force_drift_sigma_n=0.05 * peak)}))


def followed(bench, small, pull, young=None, **settings):
    """The result of an estimate from a start, as its interval; None: refused."""
    chosen = FitSpec(hold_out=False, mesh_check=False, poisson=0.36, key_frames=6,
                              young=young, **settings)
    subject = subject_of(bench, small)
    if young is not None:
        subject = replace(subject, start=replace(subject.start, young=np.full(4, young)))
    try:
        found = fit_branch([pull], subject, chosen, log=EvaluationLog(None, ""))
        require_result(found, subject.skeleton)
    except LimberError:
        return None
    judge_model(found, subject, pull.entry.grasp, chosen, axes=None, cloud=None)
    return total_interval(found.values.young, found.uncertainty.young_interval, found.model_error)


@pytest.mark.slow
@pytest.mark.parametrize("advised", [
    {}, {"young": 1e5}, {"young": 1e10}, {"drive": "pose"}, {"free_frame": True}])
def test_intervals_hold_whatever_was_advised(small_bench, small, off, advised):
    """Another start, a prescribed path, a free frame."""
    interval = followed(small_bench, small, off, **advised)
    assert interval is None or np.all((interval[:, 0] < TRUTH) & (TRUTH < interval[:, 1]))


@pytest.mark.slow
def test_a_start_changes_no_result(small_bench, small, off):
    """A hundred times too soft or too stiff, the fit ends where it ends without advice."""
    usual = np.log(followed(small_bench, small, off))
    wide = np.diff(usual, axis=1)[:, 0]
    for young in (1e5, 1e10):
        other = followed(small_bench, small, off, young=young)
        if other is not None:
            assert np.all(np.abs(np.log(other) - usual).max(axis=1) < 0.15 * wide)


@pytest.mark.slow
def test_their_true_places_narrow_the_interval(small_bench, small, small_pull, off):
    """As --nominal states them: no worse, and the truth is still inside."""
    entry = off.entry.model_copy(update={"rest_points_m": small_pull.entry.rest_points_m})
    interval = followed(small_bench, small, replace(off, entry=entry))
    assert np.all((interval[:, 0] < TRUTH) & (TRUTH < interval[:, 1]))
