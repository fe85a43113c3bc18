"""As many control points as the pulls support."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.paper_branches import Bench, PaperBranch, exact_pull, measured
from limber.cli.main import call
from limber.estimation.control_point_count import equal_fractions, is_open, supported
from limber.estimation.estimated_branch import subject_of
from limber.estimation.fit import fit_branch
from limber.estimation.fitting.objective import EvaluationLog
from limber.estimation.settings import FitSpec
from limber.geometry.skeleton.skeleton import FRACTIONS
from limber.recordings.recording import EXACT

QUICK = FitSpec(key_frames=6, hold_out=False, mesh_check=False, gravity=False,
                         poisson=0.35)


class _OnTheFitsMesh(PaperBranch):
    """A uniform branch on another mesh is no longer uniform to a thousandth of its force."""

    def truth(self):
        return replace(super().truth(), mesh=self.mesh(slice_length=2.4, sides=6))


def support(young):
    branch = _OnTheFitsMesh("drawn", young, 0.35, 0.40, (0.010, 0.008), 0.4)
    bench = Bench(branch, slice_length=2.4, sides=6)
    pull = measured(exact_pull(branch, 0, frames=20), 3, points=2e-4, force=0.004)
    pull = replace(pull, entry=pull.entry.model_copy(update={
        "calibration": EXACT, "rest_points_m": tuple(map(tuple, bench.points.tolist()))}))
    count = bench.mesh.tet_count
    mesh = bench.mesh.with_data(cell_data={"young": np.full(count, 2e7),
                                           "poisson": np.full(count, 0.35),
                                           "density": np.full(count, 900.0)})
    subject = subject_of(mesh, branch.skeleton, (), (0.0, 0.0, 0.0), QUICK)
    found = fit_branch([pull], subject, QUICK, log=EvaluationLog(None, ""), quick=True)
    return supported(found)


@pytest.mark.slow
def test_a_uniform_branch_has_one_and_a_graded_one_the_four_of_its_truth():
    uniform, graded = support(4 * (2e7,)), support((40e6, 22e6, 12e6, 3e6))
    assert uniform.fractions == equal_fractions(1) and graded.fractions == FRACTIONS
    assert uniform.start.young == pytest.approx([2e7], rel=0.02)
    for found in (uniform, graded):
        assert list(found.evidence) == [1, 2, 3, 4, 5, 6]
    # One modulus cannot explain a fall by a factor of 13.
    assert graded.evidence[1] < graded.evidence[4] - 100


@pytest.mark.slow
def test_a_modulus_that_goes_up_and_down_needs_more_than_four():
    found = support((20e6, 60e6, 10e6, 40e6, 8e6, 20e6))
    assert found.fractions == equal_fractions(6)
    assert found.evidence[6] > found.evidence[4] + 3


@pytest.mark.slow
def test_an_estimate_chooses_them_if_none_are_given(branch_folder, capsys):
    """The truth has four, at the paper's positions."""
    assert call(["estimate", str(branch_folder), "--json", "--progress", "none",
                 "--quick"]) == 0
    line = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    evidence = {int(count): value for count, value in line["control_point_evidence"].items()}
    assert evidence[len(line["fractions"])] > max(evidence.values()) - 3
    assert len(line["young_pa"]) == len(line["fractions"])
    known = json.loads((branch_folder / "estimate.json").read_text())
    assert known["fractions"] == pytest.approx(line["fractions"], abs=0.02)


def test_given_control_points_stay_and_other_methods_have_four():
    assert is_open(FitSpec()) and FitSpec().initial_fractions == FRACTIONS
    for given in ({"fractions": FRACTIONS}, {"method": "nelder-mead"}, {"forward": "reduced"},
                  {"field": "inverse_distance"}):
        assert not is_open(FitSpec(**given))
        assert FitSpec(**given).initial_fractions == FRACTIONS
