"""What a fit starts from."""

import json

import numpy as np
import pytest

from limber.estimation.parameters import Values
from limber.estimation.settings import EstimateSettings
from limber.mechanics.statics.solve import solve_static
from limber.store import Branch
from limber.store.loading import load_estimated_subject, load_subject


def test_left_out_twigs_weigh_on_the_branch_that_is_fitted(branch_folder):
    """Twigs that the mesh leaves out hang on the model of a pull that gravity bends."""
    branch = Branch.open(branch_folder)
    bare = load_subject(branch, EstimateSettings()).model
    with branch.stage("mesh") as stage:
        stage.path("point_masses.json").write_text(json.dumps(
            [{"mass_kg": 0.02, "centre_m": [0.1, 0, 0.2], "attached_m": [0, 0, 0.2]}]))
    loaded = load_subject(branch, EstimateSettings()).model
    stiff = {"young": 1e12, "gravity": (0.0, 0.0, -9.80665)}
    base = [solve_static(model.with_parameters(**stiff)).require().base_force[2]
            for model in (bare, loaded)]
    assert base[1] - base[0] == pytest.approx(0.02 * 9.80665, rel=1e-6)


def test_an_older_estimate_keeps_its_field(branch_folder):
    """Its numbers of the field's form were of deviations that did not grow with the moduli's
    steps; one with the paper's field has none."""
    branch = Branch.open(branch_folder)
    older = {"fractions": [0.2, 0.4, 0.6, 0.8], "field_form": [0.5] * 6}
    newer = older | {"field_form_deviations": [0.3, 0.1, 0.1, 0.1, 0.3]}
    values = Values(np.array([8e9, 4e9, 1e9, 1e9]), 0.35, 900.0)
    before, now = (load_estimated_subject(branch, known, gravity=True).field.deviations(values)
                   for known in (older, newer))
    assert now[0] > 1.1 * before[0] and now[-1] == pytest.approx(before[-1])
    plain = load_estimated_subject(branch, older | {"field_form": []}, gravity=True)
    assert plain.field is None
