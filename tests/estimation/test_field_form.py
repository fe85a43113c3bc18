"""How Young's modulus runs between the control points, as unknowns of a fit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares, minimize
from tests.subjects.forced_pulls import by_differences

from benchmarks.paper_branches import Bench, PaperBranch
from limber.core.errors import InputError
from limber.estimation.parameters import (
    BULK,
    LINK_DEVIATION,
    ParameterSpace,
    Values,
    YoungField,
    open_field,
)
from limber.estimation.uncertainty.covariance import marginal_step
from limber.mechanics.materials.materials import LayeredSection

TRUTH = np.array([40e6, 22e6, 12e6, 3e6])
FRACTIONS = (0.2, 0.4, 0.6, 0.8)


@pytest.fixture(scope="module")
def field(small_bench):
    return open_field(small_bench.mesh, small_bench.branch.skeleton, small_bench.weights, FRACTIONS)


def test_shares_are_the_derivatives_of_the_field(field):
    rng = np.random.default_rng(1)
    extra = field.names
    space = ParameterSpace(Values(TRUTH, 0.35, 900.0), (0, 1, 2, 3), extra)
    free = np.r_[np.log(TRUTH), 0.5 * rng.standard_normal(len(extra))]
    slopes = by_differences(lambda each: np.log(field.young(space.unpack(each))), free, 1e-5)
    assert slopes.T == pytest.approx(field.shares(space.unpack(free), extra), abs=1e-7)


def test_any_form_keeps_the_moduli_at_the_control_points(field, small_bench):
    """Mixture and bumps change the field between them, not there."""
    values = Values(TRUTH, 0.35, 900.0, form=tuple(np.linspace(-1.5, 2, len(field.names))))
    young = field.young(values)
    for point, true in zip(small_bench.points, TRUTH, strict=True):
        nearest = np.argmin(np.linalg.norm(small_bench.mesh.centroids - point, axis=1))
        assert young[nearest] == pytest.approx(true, rel=0.25)
    apart = np.log(young) - np.log(small_bench.weights @ TRUTH)
    assert np.abs(apart).max() > 0.3


def test_one_modulus_is_uniform_and_the_papers_field_is_its_weights(small_bench):
    one = open_field(small_bench.mesh, small_bench.branch.skeleton, small_bench.weights[:, :1],
                     (0.5,))
    assert one.names == ()
    plain = YoungField(small_bench.weights)
    assert plain.young(Values(TRUTH, 0.35, 900.0)) == pytest.approx(small_bench.weights @ TRUTH)


FORKED = PaperBranch("forked", (3e7,) * 4, 0.35, 0.4, (0.010, 0.008), 0.3, (0.5, 0.12))


@pytest.fixture(scope="module")
def forked():
    return Bench(FORKED)


def test_side_branches_of_each_order_have_a_ratio_of_their_own(forked):
    """Only where it is asked for, and with a wide prior; the interval is that of the fit."""
    field = open_field(forked.mesh, FORKED.skeleton, forked.weights, FRACTIONS, by_order=True)
    assert field.names[-1] == "form of side branches of order 1"
    values = Values(TRUTH, 0.35, 900.0, form=(0.0,) * (len(field.names) - 1) + (-1.0,))
    plain = replace(values, form=(0.0,) * len(field.names))
    ratio = np.log(field.young(values) / field.young(plain))
    aside = forked.mesh.centroids[:, 0] < forked.mesh.centroids[:, 0].min() + 0.04
    assert ratio[aside] == pytest.approx(-LINK_DEVIATION) and 0.5 < np.mean(ratio == 0) < 1
    found, = field.order_moduli(values, {field.names[-1]: 0.5})
    assert found["order"] == 1 and found["factor"] == pytest.approx(np.exp(-LINK_DEVIATION))
    assert np.log(found["interval"]) == pytest.approx(-LINK_DEVIATION * np.array([1.98, 0.02]))


def test_layers_are_in_every_form_of_the_field(small_bench):
    """A hollow branch of one modulus: the equivalent one of thin sections is the lower."""
    section = LayeredSection(pith_radius=5e-3)
    factor = section.on(small_bench.mesh, small_bench.branch.skeleton)
    assert factor.min() == pytest.approx(1 - (5 / 8)**4, abs=0.02)
    assert factor.max() == pytest.approx(1 - (5 / 10)**4, abs=0.02)
    field = open_field(small_bench.mesh, small_bench.branch.skeleton,
                       factor[:, None] * small_bench.weights, FRACTIONS,
                       log_factor=np.log(factor))
    one = Values(np.full(4, 2e7), 0.35, 900.0, form=(-0.7,) + (0.0,) * (len(field.names) - 1))
    assert field.young(one) == pytest.approx(2e7 * factor)
    with pytest.raises(InputError, match="No wood is left"):
        LayeredSection(pith_radius=8e-3).on(small_bench.mesh, small_bench.branch.skeleton)


@pytest.mark.parametrize(("section", "factor"), [
    (LayeredSection(), 1.0), (LayeredSection(pith_radius=5e-3), 1 - 0.5**4),
    (LayeredSection(bark_thickness=1e-3, bark_modulus=1.0), 1.0),
    (LayeredSection(bark_thickness=1e-3, bark_modulus=0.1), 0.9**4 + 0.1 * (1 - 0.9**4))])
def test_a_layered_section_bends_as_its_layers(section, factor):
    assert section.bending_factor(np.array([0.01])) == pytest.approx(factor)


def test_a_prior_is_a_row_of_its_own():
    """Standardised distance from its mean; links come after it."""
    space = ParameterSpace(Values(TRUTH, 0.35, 900.0), (0, 1, 2, 3), (BULK,),
                           links=((0, 1),), priors=((BULK, np.log(1.4 / 0.2) - 0.1, 0.05),))
    rows, offsets = space.own_rows()
    assert rows.shape == (2, 5) and space.own_row_count == 2
    free = space.pack(Values(TRUTH, 0.4, 900.0))
    assert (rows @ free - offsets)[0] == pytest.approx(2.0)


def test_other_forms_lie_within_what_is_expected_of_them(field, small_bench):
    """A monotone cubic through moduli that differ severalfold is no rare form of the field; with
    bumps as of a uniform branch it lay far outside."""
    nodes = small_bench.branch.skeleton.nodes
    along = np.linalg.norm(small_bench.mesh.centroids[:, None] - nodes[None], axis=2).argmin(
        axis=1) / (len(nodes) - 1)
    young = np.exp(np.log(2e9) - np.array([0.0, 2.0, 2.1, 3.4]))
    course = PchipInterpolator(FRACTIONS, np.log(young))(np.clip(along, 0.2, 0.8))
    # It runs on over a quarter of the way to the next control point, and levels off.
    course += np.interp(along, [0.15, 0.2, 0.8, 0.85], [0.5, 0.0, 0.0, -0.33])

    def farthest(chosen: YoungField) -> float:
        values = Values(young, 0.35, 900.0, form=(0.0,) * len(chosen.names))
        form = np.zeros(len(chosen.names))
        for _ in range(3):
            known = replace(values, form=tuple(form.tolist()))
            slopes = chosen.shares(known, chosen.names)[len(young):].T / 0.05
            missing = (course - np.log(chosen.young(known))) / 0.05
            rows = np.vstack([slopes, np.eye(len(form))])
            form += np.linalg.lstsq(rows, np.r_[missing, -form], rcond=None)[0]
        return float(np.abs(form).max())

    assert farthest(field) < 2.0


def test_bumps_are_small_where_the_modulus_does_not_change(field):
    uniform, steep = (Values(np.array(young), 0.35, 900.0) for young in (
        [1e9] * 4, [8e9, 1e9, 1e9, 1e9]))
    assert field.deviations(uniform) == pytest.approx(field.widths)
    growth = field.deviations(steep) / field.widths
    # At the base and halfway to the second control point; elsewhere nothing steps.
    assert growth[:2] == pytest.approx(np.hypot(1, np.log(8) * np.array([1.0, 1.5])))
    assert growth[2:] == pytest.approx(1.0)


# Moduli with the form of their field integrated out, against the integral itself.

FORMS = np.linspace(-4, 4, 17)


def two_moduli():
    """Four pieces between two control points, and readings of sums of their log E."""
    straight = np.array([[1.0, 0.0], [0.7, 0.3], [0.3, 0.7], [0.0, 1.0]])
    field = YoungField(
        np.array([[0.9, 0.1], [0.6, 0.4], [0.4, 0.6], [0.1, 0.9]]), straight,
        np.array([[0.2], [1.0], [1.0], [0.2]]), np.array([0.1]), np.array([[-0.15, 0.15]]),
        ("form", "form at 0.5"))
    base = Values(np.array([1.0, 0.2]), 0.35, 900.0)
    priors = tuple((name, 0.0, 1.0) for name in field.names)
    space = ParameterSpace(base, (0, 1), field.names, priors=priors)
    readings = np.array([[1.0, 0.0, 0.0, 0.0], [0.3, 0.4, 0.3, 0.0], [0.0, 0.3, 0.4, 0.3],
                         [0.0, 0.0, 0.0, 1.0]]) / 0.06
    wanted = readings @ np.log(field.young(
        Values(base.young, 0.35, 900.0, form=(0.4, 0.8)))) + [0.5, -0.8, 0.3, 0.6]
    return field, space, readings, wanted


@pytest.mark.slow
def test_the_step_leads_to_the_mode_of_the_integral():
    """Nearly there, and to a smaller step of the moduli than where all are likeliest together."""
    field, space, readings, wanted = two_moduli()

    def residual(free):
        values = space.unpack(free)
        return np.r_[readings @ np.log(field.young(values)) - wanted, free[2:]]

    def left(log_young):
        """Minus the logarithm of the density with all forms summed."""
        each = [residual(np.r_[log_young, one, other]) for one in FORMS for other in FORMS]
        halves = 0.5 * np.sum(np.square(each), axis=1)
        return halves.min() - np.log(np.sum(np.exp(halves.min() - halves)))

    mode = least_squares(residual, np.r_[np.log(space.base.young), 0.0, 0.0], xtol=1e-12).x
    true = minimize(left, mode[:2], method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-9}).x
    values = space.unpack(mode)
    slopes = np.vstack([readings @ field.shares(values, space.extra).T, np.eye(4)[2:]])
    step = marginal_step(mode, slopes, space, field)
    off, still_off = true - mode[:2], true - mode[:2] - step[:2]
    assert np.linalg.norm(off) > 5e-3
    assert np.linalg.norm(still_off) < 0.4 * np.linalg.norm(off)
    assert abs(np.diff(true)[0]) < abs(np.diff(mode[:2])[0])


def test_growth_equals_differences():
    """Of the mixture and of a bump, by steps of each modulus."""
    field, space, _, _ = two_moduli()
    values = space.base

    def sizes(log_young):
        shares = field.shares(Values(np.exp(log_young), 0.35, 900.0), space.extra)[2:]
        return np.log(np.linalg.norm(shares, axis=1))

    found, centre = field.growth(values), np.log(values.young)
    for modulus in range(2):
        step = 1e-5 * np.eye(2)[modulus]
        slope = (sizes(centre + step) - sizes(centre - step)) / 2e-5
        assert np.allclose(found[:, modulus], slope, rtol=1e-5, atol=1e-8)
