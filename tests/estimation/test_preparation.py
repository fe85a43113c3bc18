"""What a fit starts from."""

import json

import pytest

from limber.estimation.settings import FitSpec
from limber.mechanics.statics.solve import solve_static
from limber.store import Branch
from limber.store.loading import load_subject


def test_left_out_twigs_weigh_on_the_branch_that_is_fitted(branch_folder):
    """Twigs that the mesh leaves out hang on the model of a pull that gravity bends."""
    branch = Branch.open(branch_folder)
    bare = load_subject(branch, FitSpec()).model
    with branch.stage("mesh") as stage:
        stage.path("point_masses.json").write_text(json.dumps(
            [{"mass_kg": 0.02, "centre_m": [0.1, 0, 0.2], "attached_m": [0, 0, 0.2]}]))
    loaded = load_subject(branch, FitSpec()).model
    stiff = {"young": 1e12, "gravity": (0.0, 0.0, -9.80665)}
    base = [solve_static(model.with_parameters(**stiff)).require().base_force[2]
            for model in (bare, loaded)]
    assert base[1] - base[0] == pytest.approx(0.02 * 9.80665, rel=1e-6)
