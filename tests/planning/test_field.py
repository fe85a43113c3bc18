"""The energy field: reproduces an analytic branch, knows its own error and its own limits."""

from dataclasses import replace

import numpy as np
import pytest
from tests.planning.conftest import small_grasp_model

from limber.core.errors import InputError, WorkError
from limber.planning.field import energy_field
from limber.planning.field.chart import Chart
from limber.planning.field.energy_field import EnergyField, error_measures, fit_field
from limber.planning.field.radial import RadialInterpolant
from limber.planning.field.sampling import energy_inputs
from limber.planning.field.valid_region import TrustRegion

ELSEWHERE = np.random.default_rng(9).uniform(-0.1, 0.1, (80, 3))


def test_analytic_energy_and_force_are_reproduced(ridge, ridge_field):
    """At unseen points inside, energy within 2 % and force within 5 % (root mean square)."""
    energy = ridge_field.energy(ELSEWHERE) - ridge.energy(ELSEWHERE)
    force = ridge_field.force(ELSEWHERE) - ridge.force(ELSEWHERE)
    assert np.sqrt(np.mean(energy**2)) < 0.02 * np.sqrt(np.mean(ridge.energy(ELSEWHERE) ** 2))
    assert np.sqrt(np.mean(force**2)) < 0.05 * np.sqrt(np.mean(ridge.force(ELSEWHERE) ** 2))


def test_energy_gradient_is_that_of_the_clamped_energy(ridge_field):
    """Central differences of the energy agree with its gradient."""
    step = 1e-5
    differences = np.stack(
        [(ridge_field.energy(ELSEWHERE + step * axis) - ridge_field.energy(ELSEWHERE - step * axis))
         / (2 * step) for axis in np.eye(3)], axis=1)
    assert np.allclose(ridge_field.energy_gradient(ELSEWHERE), differences, atol=1e-4)


def test_held_out_error_tells_the_true_error(ridge, ridge_field):
    """The reported error is within a factor of five of that on fresh samples inside the hull."""
    fresh = ridge.samples(count=300, seed=77)
    fresh = fresh.take(np.flatnonzero(ridge_field.region.contains(fresh.positions)))
    true = error_measures(fresh, ridge_field.energy(fresh.positions),
                          ridge_field.force(fresh.positions))
    for name in ("energy_error", "force_error"):
        assert 0.2 < ridge_field.errors[name] / true[name] < 5.0


def test_a_fit_is_chosen_for_most_poses_and_not_for_the_stiffest(ridge, monkeypatch):
    """One that is wrong at the five stiffest of 150 poses alone is better than one that is three
    times as wrong at all others."""
    samples = ridge.samples()
    stiff = np.argsort(samples.energies)[-5:]

    def left_out(some, _chart, choice, _face):
        off = np.full(len(some.poses), 0.01 if choice.kernel == "quintic" else 0.03)
        off[stiff] = 0.5 if choice.kernel == "quintic" else 0.01
        return error_measures(some, (1.0 + off) * some.energies,
                              (1.0 + off[:, None]) * some.forces), np.zeros((len(some.poses), 4))

    monkeypatch.setattr(energy_field, "cross_validated_errors", left_out)
    assert fit_field(samples).energy_fit.kernel == "quintic"


def test_left_out_errors_are_those_of_fits_without_the_sample(ridge):
    """The closed form agrees with fitting again without each of five samples, value and gradient,
    and values alone."""
    samples = ridge.samples(count=40)
    options = {"kernel": "quintic", "smoothing": 1e-6}
    missed = RadialInterpolant.leave_one_out(samples.positions, samples.energies, samples.forces,
                                             **options)
    alone = RadialInterpolant.leave_one_out(samples.positions, samples.tips[:, :2] ** 2, **options)
    frame = np.ptp(samples.positions, axis=0)
    for j in range(5, 40, 7):
        if np.abs(samples.positions[j]).max() > 0.4 * frame.max():
            continue  # it sets the scale of the fit, which smoothing knows
        kept = samples.take(np.delete(np.arange(40), j))
        here = samples.positions[j][None]
        fit = RadialInterpolant.fit(kept.positions, kept.energies, kept.forces, **options)
        assert samples.energies[j] - fit.value(here)[0, 0] == pytest.approx(
            missed[j, 0, 0], rel=0.02, abs=1e-6)
        assert np.allclose(samples.forces[j] - fit.gradient(here)[0, :, 0], missed[j, 1:, 0],
                           rtol=0.02, atol=1e-4)
        fit = RadialInterpolant.fit(kept.positions, kept.tips[:, :2] ** 2, **options)
        assert np.allclose(samples.tips[j, :2] ** 2 - fit.value(here)[0], alone[j, 0], rtol=0.02,
                           atol=1e-6)


def test_region_along_a_shell():
    """Flattened and bent back it is the same point; heights' slopes are those of differences; the
    outline's box holds the region."""
    generator = np.random.default_rng(3)
    pivot, radius = np.array([0.01, -0.02, 0.1]), 0.3
    chart = Chart.about(pivot, radius, pivot + [0.02, 0.01, 0.3])
    flat = generator.uniform([-0.15, -0.15, -0.06], [0.15, 0.15, 0.001], (200, 3))
    corners = np.array([[x, y, 0.001] for x in (-0.15, 0.15) for y in (-0.15, 0.15)])
    flat = np.vstack([corners, flat])
    points = chart.curved(np.vstack([np.zeros(3), flat]))
    assert np.allclose(chart.map(points)[1:], flat, atol=1e-12)
    region = TrustRegion.of(points, np.empty((0, 3)), pivot, radius)
    _height, slope = region.height_and_slope(points[1:] + 1e-3)
    step = 1e-7
    for axis in range(3):
        there, back = (region.height(points[1:] + 1e-3 + side * step * np.eye(3)[axis])
                       for side in (1, -1))
        assert np.allclose((there - back) / (2 * step), slope[:, axis], atol=1e-5)
    inside = region.draw(2000, generator)
    assert (inside > region.low).all() and (inside < region.high).all()
    on_top = chart.curved(np.array([[0.03, 0.02, 0.0], [0.0, 0.05, -0.0005]]))
    assert region.contains(on_top).all(), "facets of points themselves would cut them off"


@pytest.mark.slow
def test_boxes_surely_outside_hold_nothing_that_is_trusted():
    """And nearly all that hold nothing are told: those of which the highest plane, or a refused
    pose, may speak for all."""
    generator = np.random.default_rng(8)
    pivot, radius = np.array([0.01, -0.02, 0.1]), 0.3
    chart = Chart.about(pivot, radius, pivot + [0.02, 0.01, 0.3])
    accepted = chart.curved(generator.uniform([-0.2, -0.2, -0.06], [0.2, 0.2, 0.001], (150, 3)))
    region = TrustRegion.of(accepted, accepted[:5] + 0.01, pivot, radius)
    axes = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    corners = np.stack(np.meshgrid(*3 * [np.linspace(-1.0, 1.0, 9)]), axis=-1).reshape(-1, 3)
    for half in (0.004, 0.0005):
        centres = generator.uniform(region.low, region.high, (4000, 3))
        told = region.surely_outside(centres, half * axes)
        inside = region.contains((centres[:, None] + half * corners @ axes).reshape(-1, 3))
        holds = inside.reshape(len(centres), -1).any(axis=1)
        assert not (told & holds).any()
        assert told.sum() > 0.95 * (~holds).sum() > 1000


def test_bend_of_the_chart_is_the_most_within_reach():
    """Second differences along random lines never pass it, and come near to it."""
    generator = np.random.default_rng(9)
    chart = Chart.about(np.array([0.01, -0.02, 0.1]), 0.3, np.array([0.03, -0.01, 0.4]))
    centres = chart.curved(generator.uniform([-0.5, -0.5, -0.15], [0.5, 0.5, 0.1], (300, 3)))
    most, step = chart.bend(centres, 0.02), 2e-4
    share = 0.0
    for _ in range(200):
        way, off = generator.normal(size=(2, 300, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        at = centres + 0.0199 * off / np.linalg.norm(off, axis=1, keepdims=True)
        before, here, after = (chart.map(at + side * step * way) for side in (-1, 0, 1))
        found = np.linalg.norm(after - 2.0 * here + before, axis=1) / step**2
        assert (found <= most).all()
        share = max(share, float((found / most).max()))
    assert 0.6 < share


def test_energy_below_that_of_the_hanging_state_is_clamped(well):
    """Where round-off or a snap takes the energy below 0, the field says 0, with no gradient."""
    samples = well.samples(count=80)
    samples = replace(samples, energies=samples.energies - samples.positions @ [0.0, 0.0, 0.5],
                      forces=samples.forces - [0.0, 0.0, 0.5])
    field = fit_field(samples)
    wanted = np.maximum(well.energy(ELSEWHERE) - ELSEWHERE @ [0.0, 0.0, 0.5], 0.0)
    assert np.allclose(field.energy(ELSEWHERE), wanted, atol=1e-4)
    assert (wanted == 0.0).any(), "the case must include poses where energy is clamped"
    assert not field.energy_gradient(ELSEWHERE)[wanted == 0.0].any()


def test_shape_gives_rotation_and_tip(well_field):
    """Rotation and tip, linear in position here, come back exactly."""
    poses = well_field.poses(ELSEWHERE)
    assert np.allclose(poses[:, 3], -ELSEWHERE[:, 1], atol=1e-6)
    assert np.allclose(well_field.tip(ELSEWHERE), 1.5 * ELSEWHERE + [0, 0, 0.3], atol=1e-6)


def test_trust_ends_at_the_hull_and_near_rejected_poses(ridge):
    """Outside the samples' hull, and nearer to a rejected pose than to an accepted, is refused."""
    plain = fit_field(ridge.samples()).region
    hole = np.array([0.05, -0.05, 0.02])
    holed = fit_field(ridge.samples(rejected=[[*hole, 0, 0, 0]])).region
    assert plain.contains(hole)[0] and not holed.contains(hole)[0]
    assert not plain.contains(np.array([0.3, 0.0, 0.0]))[0]
    drawn = holed.draw(500, np.random.default_rng(0))
    assert holed.contains(drawn).all() and len(drawn) == 500


def test_saved_field_is_the_same(tmp_path, ridge_field):
    """Written and read again it gives the same numbers to the bit, and nothing is pickled."""
    ridge_field.write(tmp_path / "energy.npz")
    again = EnergyField.read(tmp_path / "energy.npz")
    assert np.array_equal(again.energy(ELSEWHERE), ridge_field.energy(ELSEWHERE))
    assert np.array_equal(again.force(ELSEWHERE), ridge_field.force(ELSEWHERE))
    assert np.array_equal(again.poses(ELSEWHERE), ridge_field.poses(ELSEWHERE))
    assert again.errors == ridge_field.errors
    with np.load(tmp_path / "energy.npz", allow_pickle=False) as file:
        wanted = {"poses", "energies_j", "forces_n", "min_det_f", "rejected_poses"}
        assert wanted <= set(file.files)


@pytest.mark.parametrize(("name", "change"), [
    ("chart_layers", lambda values: values[:1]),
    ("chart_layers", lambda values: np.repeat(values, 2, axis=0)),
    ("chart_layers", lambda values: -values),
    ("shape_fit_kernel", lambda _: np.array("cubist")),
    ("energies_j", lambda values: values * 1e300)])
def test_a_field_of_odd_numbers_is_refused(tmp_path, ridge_field, name, change):
    """One chart too many or too few, no chart, no kernel, energies whose sums are not finite."""
    path = tmp_path / "energy.npz"
    ridge_field.write(path)
    with np.load(path, allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    arrays[name] = change(arrays[name])
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=r"is not an energy field|energies_j has"):
        EnergyField.read(path)


def test_damaged_file_is_named(tmp_path):
    """A file that is no energy field is an input error that says what to run."""
    path = tmp_path / "energy.npz"
    np.savez(path, poses=np.zeros((3, 6)))
    with pytest.raises(InputError, match="limber energy"):
        EnergyField.read(path)


def test_too_few_samples(well):
    """A handful of samples cannot make a field; the message asks for more."""
    with pytest.raises(WorkError, match="Sample more"):
        fit_field(well.samples(count=12))


def test_a_sample_at_a_snap_costs_the_others_no_slopes(well):
    """Where the tangent of one state is not known, the tip is foretold as well from the others."""
    def tip(points):
        return 1.5 * points + [0.0, 0.0, 0.3] + 0.02 * np.sin(25.0 * points)

    samples = well.samples(count=60)
    slopes = np.zeros((60, 3, 6))
    slopes[:, 0, 1], slopes[:, 1, 0] = 1.0, -1.0
    slopes[:, [0, 1, 2], [3, 4, 5]] = 1.5 + 0.5 * np.cos(25.0 * samples.positions)
    samples = replace(samples, tips=tip(samples.positions))
    places = well.samples(count=40, radius=0.12, seed=4).positions
    missed = []
    for known in (slopes, np.where(np.arange(60)[:, None, None] == 17, np.nan, slopes), None):
        field = fit_field(replace(samples, shape_slopes=known))
        missed.append(np.sqrt(np.mean((field.tip(places) - tip(places))**2)))
    assert missed[1] < 1.5 * missed[0] < 0.7 * missed[2]


def test_a_field_knows_its_branch_on_any_machine(small_mesh, small_skeleton):
    """Last digits of a grasp's weights differ between machines, to which a folder may be moved."""
    model = small_grasp_model(small_mesh, small_skeleton, None)
    inputs = energy_inputs(model)
    elsewhere = replace(model.grasp, weights=np.nextafter(model.grasp.weights, 1.0))
    assert energy_inputs(replace(model, grasp=elsewhere)) == inputs
