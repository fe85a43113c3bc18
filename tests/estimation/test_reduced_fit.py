"""The fit on a reduced model, corrected by the full one."""

from dataclasses import replace

import numpy as np
import pytest
from tests.stages.specified import Fit

from benchmarks.paper_branches import Bench, measured
from limber.core.errors import InputError
from limber.core.progress import Progress
from limber.estimation.fit import fit_pulls
from limber.estimation.fitting import reduced_fit
from limber.estimation.fitting.optimise import gauss_newton
from limber.estimation.fitting.reduced_fit import CorrectedForward, Reduction
from limber.estimation.settings import FitSpec

SETTINGS = FitSpec(poisson=0.36, hold_out=False, key_frames=16)
REDUCED = SETTINGS.model_copy(update={"forward": "reduced"})
TRUTH = np.array([40e6, 22e6, 12e6, 3e6])


@pytest.fixture(autouse=True)
def few_states(monkeypatch):
    """What a basis costs grows with the fourth power of its size; corrections make up for it."""
    for name, few in (("SIZE", 24), ("STATES_PER_PULL", 12), ("STATES_AROUND", 12)):
        monkeypatch.setattr(reduced_fit, name, few)


@pytest.fixture(scope="module")
def thick(small):
    """A coarse mesh: what is shown here does not depend on how fine it is."""
    return Bench(small, slice_length=3.0, sides=6)


@pytest.fixture(scope="module")
def noisy(small_pull):
    return measured(small_pull, 3, points=5e-4, force=0.01)


def fit(bench, pulls, settings, **kept):
    objective, messages = bench.objective(pulls, settings), []
    found = fit_pulls(objective, objective.space.base, settings,
                      Progress(on_warning=messages.append), **kept)
    found.warnings = messages
    return found


@pytest.mark.slow
def test_it_ends_where_the_full_model_ends(thick, noisy, tmp_path):
    """Moduli to 0.3 %, intervals to a few percent; the second time the basis is there, and no
    rough fit of the full model is needed: a few simulations are enough.
    """
    full = fit(thick, [noisy], SETTINGS)
    first = fit(thick, [noisy], REDUCED, cache=tmp_path)
    again = fit(thick, [noisy], REDUCED, cache=tmp_path)
    for found in (first, again):
        assert found.fit.converged
        assert np.abs(found.values.young / full.values.young - 1).max() < 3e-3
        ratio = (np.log(found.uncertainty.young_interval) @ [-1, 1]) / (
            np.log(full.uncertainty.young_interval) @ [-1, 1])
        assert np.abs(ratio - 1).max() < 0.1
        assert found.objective.forwards[0].reduction_error[0] < 1e-4
    assert again.objective.forward_count < first.objective.forward_count
    # Another pull makes another basis, and the old file goes.
    fit(thick, [replace(noisy, name="pull-2")], REDUCED, cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.slow
def test_a_basis_around_wrong_moduli_is_made_again(thick, small_pull):
    """Started from a basis a factor of 4 off, the fit still ends at the full model's."""
    pull = measured(small_pull, 0, points=0, force=0)
    full = fit(thick, [pull], SETTINGS)
    objective = thick.objective([pull], SETTINGS)
    reduction = Reduction(objective.forwards)
    values = replace(objective.space.base, young=4.0 * TRUTH)
    reduction.build(values)
    before = reduction.bases[0]
    found, _ = reduced_fit.fit_reduced(objective, np.log(values.young), gauss_newton,
                                       gauss_newton, reduction)
    assert reduction.bases[0] is not before
    assert np.abs(np.exp(found.evaluation.free) / full.values.young - 1).max() < 2e-3


@pytest.mark.slow
def test_poisson_and_density_by_differences(thick, noisy, monkeypatch):
    """Derivatives to what the reduced model has none of, against the full model's."""
    for name, many in (("SIZE", 56), ("STATES_PER_PULL", 24), ("STATES_AROUND", 24)):
        monkeypatch.setattr(reduced_fit, name, many)
    entry = noisy.entry.model_copy(update={"gravity_m_s2": (0.0, 0.0, -9.81)})
    objective = thick.objective([replace(noisy, entry=entry)], SETTINGS)
    reduction = Reduction(objective.forwards)
    values = replace(objective.space.base, young=TRUTH)
    reduction.build(values)
    corrected = reduction.objective(objective, values).forwards[0]
    assert isinstance(corrected, CorrectedForward)
    extra = ("poisson", "density")
    full = objective.forwards[0].simulate(values, extra, True)
    rough = corrected.simulate(values, extra, True)
    keys = objective.forwards[0].keys
    for column in (4, 5):
        # Points hardly move with Poisson's ratio, and the basis knows nothing of it.
        for name, part in (("d_positions", 0.3 if column == 4 else 0.05), ("d_forces", 0.05)):
            exact = getattr(full, name)[keys][..., column]
            assert np.linalg.norm(getattr(rough, name)[keys][..., column] - exact) < (
                part * np.linalg.norm(exact)), (column, name)


@pytest.mark.slow
def test_a_correction_makes_up_for_a_poor_basis(thick, noisy, monkeypatch):
    """26 coordinates around other moduli are too few; after a correction positions and forces
    are the full model's there, and to second order near there.
    """
    monkeypatch.setattr(reduced_fit, "SIZE", 10)
    objective = thick.objective([noisy], SETTINGS)
    reduction = Reduction(objective.forwards)
    values = replace(objective.space.base, young=TRUTH * [1.4, 0.8, 1.3, 0.8])
    reduction.build(values)
    corrected = reduction.objective(objective, values).forwards[0]
    here = replace(values, young=TRUTH)
    assert corrected.correct(here, ())
    keys = objective.forwards[0].keys
    near = replace(values, young=1.05 * TRUTH)
    full = objective.forwards[0].simulate(near, (), False)
    bare = corrected.reduced.simulate(near, (), False)
    better = corrected.simulate(near, (), False)
    for name in ("positions", "forces"):
        exact = getattr(full, name)[keys]
        before, after = (np.abs(getattr(found, name)[keys] - exact).max()
                         for found in (bare, better))
        assert after < 0.1 * before


@pytest.mark.slow
def test_a_pull_of_three_frames_is_enough_for_a_basis(thick, small_pull):
    """Fewer poses than a basis has coordinates: it has others around them."""
    seen = small_pull.observations
    few = replace(measured(small_pull, 0, points=0, force=0), observations=replace(
        seen, times=seen.times[::7], positions=seen.positions[::7]))
    reduction = Reduction(thick.objective([few], SETTINGS).forwards)
    reduction.build(replace(thick.objective([few], SETTINGS).space.base, young=TRUTH))
    assert reduction.bases[0].size == 40


def test_pulls_it_cannot_hold_are_refused(thick, noisy):
    """A pull driven by force has no pose to hold the reduced model at."""
    pull = replace(noisy, entry=noisy.entry.model_copy(update={"drive": "force"}))
    with pytest.raises(InputError, match="--forward full"):
        Reduction(thick.objective([pull], SETTINGS).forwards)


@pytest.mark.slow
def test_other_control_points_make_another_basis(branch_folder):
    """Estimated again with other fractions: the basis for the first ones is not taken (it has
    another number of moduli), and the estimate is near the first where both have a point.
    """
    settings = FitSpec(forward="reduced", mesh_check=False, key_frames=8)
    first = Fit.of(settings, branch_folder=branch_folder).run()
    again = Fit.of(settings.model_copy(update={"fractions": (0.2, 0.5, 0.8)}),
                   branch_folder=branch_folder).run()
    assert len(again["young_pa"]) == 3
    assert again["young_pa"][0] == pytest.approx(first["young_pa"][0], rel=0.1)
