"""As many control points as the pulls support."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.paper_branches import Bench, PaperBranch, exact_pull, measured
from limber.cli.main import call
from limber.core.errors import InputError
from limber.estimation.control_point_count import equal_fractions, supported_fractions
from limber.estimation.estimated_branch import subject_of
from limber.estimation.settings import EstimateSettings
from limber.recordings.cell_errors import EXACT

QUICK = EstimateSettings(key_frames=6, hold_out=False, mesh_check=False, gravity=False,
                         poisson=0.35)


def supported(young):
    branch = PaperBranch("drawn", young, 0.35, 0.40, (0.010, 0.008), 0.4)
    bench = Bench(branch, slice_length=2.4, sides=6)
    pull = measured(exact_pull(branch, 0, frames=20), 3, points=5e-4, force=0.01)
    pull = replace(pull, entry=pull.entry.model_copy(update={"calibration": EXACT}))
    count = bench.mesh.tet_count
    mesh = bench.mesh.with_data(cell_data={"young": np.full(count, 2e7),
                                           "poisson": np.full(count, 0.35),
                                           "density": np.full(count, 900.0)})
    return supported_fractions([pull], lambda fractions: subject_of(
        mesh, branch.skeleton, (), (0.0, 0.0, 0.0), QUICK.model_copy(update={
            "fractions": fractions})), QUICK)


@pytest.mark.slow
@pytest.mark.parametrize(("young", "least", "most"), [((2e7,), 1, 2),
                                                      ((40e6, 22e6, 12e6, 3e6), 2, 4)])
def test_a_uniform_branch_needs_fewer_than_a_graded_one(young, least, most):
    """Fewer than the truth has explain it as well where the steps are alike."""
    fractions, known = supported(young)
    assert fractions == equal_fractions(len(fractions))
    assert known[len(fractions)] > max(known.values()) - 1
    assert least <= len(fractions) <= most
    assert min(known) == 1 and len(known) >= 3


@pytest.mark.slow
def test_the_estimate_takes_them(branch_folder, capsys):
    assert call(["estimate", str(branch_folder), "--control-points", "evidence", "--json",
                 "--progress", "none", "--key-frames", "6", "--no-mesh-check"]) == 0
    line = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert len(line["young_pa"]) == len(line["fractions"])
    evidence = {int(count): value for count, value in line["control_point_evidence"].items()}
    assert evidence[len(line["fractions"])] > max(evidence.values()) - 1
    known = json.loads((branch_folder / "estimate.json").read_text())
    assert len(known["fractions"]) == len(line["fractions"])


def test_nelder_mead_gives_no_evidence():
    with pytest.raises(InputError, match="derivatives"):
        supported_fractions([], lambda _: None, EstimateSettings(method="nelder-mead"))
