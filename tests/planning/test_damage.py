"""Probability of damage by break tests and by species, and what is said of a plan's peak strain."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy

from limber.core.errors import InputError
from limber.core.progress import Progress
from limber.planning.constraints import damage
from limber.planning.constraints.damage import DamageAlong, Strength, assumed, read_break_tests
from limber.planning.constraints.limits import Limits
from limber.planning.settings import PlanSpec
from limber.results.findings import path_sentence
from limber.results.report.figures import damage_along_branch
from limber.stages.paths.plan import Plan
from limber.stages.paths.plan_strength import (
    default_limit,
    strength_for,
    strength_of_plan,
    with_damage,
)

SHAPE, SCALE = 6.0, 0.05


def broken_at(count, generator):
    return SCALE * generator.weibull(SHAPE, count)


def breaking(strains):
    """Return the true share of branches that break at strains."""
    return -np.expm1(-(strains / SCALE)**SHAPE)


@pytest.mark.slow
def test_a_limit_by_few_tests_breaks_as_many_as_allowed():
    """Over many sets of eight tests, a strain limit for 5 % breaks 5 % of new branches; by the fit
    alone, as if it were exact, it would break more."""
    generator = np.random.default_rng(1)
    sets = broken_at((100, 8), generator)
    limits = [Strength.of_tests(strains, "tests").strain_limit(0.05) for strains in sets]
    assert np.mean(breaking(np.array(limits))) == pytest.approx(0.05, abs=0.012)
    fits = [scipy.stats.weibull_min.fit(strains, floc=0.0) for strains in sets[:20]]
    exact = np.array([scale * (-np.log(0.95))**(1.0 / shape) for shape, _, scale in fits])
    assert np.mean(breaking(exact)) > 1.3 * np.mean(breaking(np.array(limits[:20])))


def test_many_tests_find_the_distribution_and_more_strain_breaks_more():
    strength = Strength.of_tests(broken_at(300, np.random.default_rng(2)), "tests")
    assert np.median(strength.shapes) == pytest.approx(SHAPE, rel=0.1)
    assert strength.median == pytest.approx(SCALE * np.log(2)**(1 / SHAPE), rel=0.02)
    damages = [strength.damage(strain) for strain in (0.0, 0.02, 0.04, 0.06, 0.2)]
    assert damages[0] == 0.0 and damages == sorted(damages) and damages[-1] == pytest.approx(1.0)
    assert strength.damage(strength.strain_limit(0.01)) == pytest.approx(0.01, rel=1e-6)
    unsure = Strength(strength.shapes, strength.scales, 0.2, "tests")
    assert unsure.strain_limit(0.01) < 0.95 * strength.strain_limit(0.01)


def test_a_species_has_the_scatter_of_the_handbook():
    ash = Strength.of_species("ash")
    drawn = ash.scales[0] * np.random.default_rng(0).weibull(ash.shapes[0], 200_000)
    assert drawn.mean() == pytest.approx(9500 / 1.44e6, rel=0.01)
    assert drawn.std() / drawn.mean() == pytest.approx(0.27, rel=0.02)
    assert ash.describe(0.003)["damage_probability"] < 0.1 < ash.damage(0.006)
    assert assumed(0.01)["peak_strain"] > assumed(0.01)["median_strain"]
    with pytest.raises(KeyError):
        Strength.of_species("beech")


@pytest.mark.parametrize(("lines", "words"), [
    (["strain"], "no column strain_at_break"),
    (["strain_at_break", "0.05", "5"], "Line 3 .*'5'"),
    (["strain_at_break", "nan"], "Line 2"),
    (["strain_at_break", "0.05", "0.04"], "2 break tests"),
    (["strain_at_break", *["0.05"] * 6], "the same strain"),
])
def test_break_tests_that_say_nothing_are_refused(tmp_path, lines, words):
    path = tmp_path / "tests.csv"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=words):
        Strength.of_tests(read_break_tests(path), str(path))


BARE = SimpleNamespace(manifest=SimpleNamespace(stages={}))
SCANNED = SimpleNamespace(manifest=SimpleNamespace(stages={"reconstruct": SimpleNamespace(result={
    "radius_sigma_median_m": 0.001, "radius_min_m": 0.004, "radius_max_m": 0.006})}))


def test_a_probability_of_damage_limits_the_strain(tmp_path):
    """By tests before the species; the handbook's half no longer counts; a radius that is not known
    well lowers it; without a strength it is refused."""
    settings = PlanSpec(wood="ash", max_damage=0.01)
    assert Limits.of(settings).strain == np.inf
    assert Limits.of(PlanSpec(wood="ash")).strain < 0.01
    known, unsure = (strength_for(branch, settings, None) for branch in (BARE, SCANNED))
    limits = with_damage(Limits.of(settings), settings, known)
    assert known.damage(limits.strain) == pytest.approx(0.01)
    assert with_damage(Limits.of(settings), settings, unsure).strain < 0.95 * limits.strain
    assert with_damage(Limits(strain=1e-4), settings, known).strain == 1e-4
    path = tmp_path / "tests.csv"
    path.write_text("shoot,strain_at_break\n" + "".join(
        f"{k},{strain}\n" for k, strain in enumerate((0.04, 0.05, 0.055, 0.06, 0.052, 0.047))))
    tested = strength_for(BARE, settings, path)
    assert tested.tests == 6 and tested.median > 5.0 * known.median
    with pytest.raises(InputError, match="--break-tests"):
        strength_for(BARE, PlanSpec(max_damage=0.01), None)
    assert strength_for(BARE, PlanSpec(), None) is None


def test_a_plan_keeps_under_a_strength_that_is_known_or_assumed():
    """By half, unless the user limits the strain. Of stems softer than wood nothing is assumed."""
    settings, tests = PlanSpec(), Strength.of_tests(np.linspace(0.04, 0.06, 9), "tests")
    assert with_damage(Limits(), settings, tests, 1e8).strain == pytest.approx(0.5 * tests.median)
    assert with_damage(Limits(), settings, None, 8e9).strain == pytest.approx(0.003)
    assert with_damage(Limits(), settings, None, 1e8).strain == np.inf
    own = PlanSpec(max_strain=0.02)
    assert with_damage(Limits.of(own), own, tests, 8e9).strain == 0.02
    ash = PlanSpec(wood="ash")
    of_ash = with_damage(Limits.of(ash), ash, Strength.of_species("ash"), 8e9)
    assert of_ash.strain == Limits.of(ash).strain
    assert "0.3 %, half of that at which" in default_limit(Limits(strain=0.003), settings, None)
    assert not default_limit(Limits(strain=0.02), own, None)
    assert not default_limit(Limits.of(ash), ash, None)


def test_a_plan_over_its_strength_is_said_to_be():
    """By the largest strain, in motion as well; a warning where the strength is known."""
    states = SimpleNamespace(strains=np.array([0.001, 0.004]), poses=np.arange(12.0).reshape(2, 6),
                             strain_places=np.zeros((2, 3)))
    plan, told = SimpleNamespace(ahead=states), []
    progress = Progress(on_warning=told.append)
    calm = strength_of_plan(Strength.of_species("ash"), plan, None, progress)
    assert not calm["over"] and 0.0 < calm["damage_probability"] < 0.5 and not told
    moving = {"peaks": {"strain": {"moving": 0.009}}}
    over = strength_of_plan(Strength.of_species("ash"), plan, moving, progress)
    assert over["over"] and over["peak_strain"] == 0.009 and "--max-damage" in told[0]
    unknown = strength_of_plan(None, plan, moving, progress)
    assert unknown["over"] and unknown["damage_probability"] is None and len(told) == 1
    assert np.array_equal(unknown["grasp_m"], [6.0, 7.0, 8.0])
    rows = Plan.of({"baseline": {}, "plan": {}, "strength": over}).comparison()
    assert rows[-2][2] == "1.4" and rows[-1][0].startswith("probability of damage")
    said = path_sentence({"plan": {"length_m": 0.1}, "strength": over})
    assert said.startswith("The gentle path damages the branch with a probability of ")


def test_the_branch_is_drawn_where_it_would_break(small_model, small_skeleton, tmp_path):
    """Bent by its grasp it is strained most where the tetrahedra are; each place has its own
    probability, the largest strain's that of the plan; the picture survives the file."""
    place = small_model.rest_position + [0.03, 0.0, 0.0]
    bent = small_model.follow(place[None], small_model.rest.displacement)[0].displacement
    strength = Strength.of_species("ash")
    states = [small_model.rest.displacement, bent]
    along = DamageAlong.of(small_model, small_skeleton, states, strength)
    assert along.strains.max() == pytest.approx(small_model.peak_load(bent)[0], rel=1e-6)
    assert along.probabilities.max() == pytest.approx(strength.damage(along.strains.max()))
    assert along.strains.min() < 0.5 * along.strains.max()
    with open(tmp_path / "damage.csv", "w") as stream:
        along.write(stream)
    read = DamageAlong.read(tmp_path / "damage.csv")
    assert np.allclose(read.probabilities, along.probabilities, rtol=1e-4)
    assert np.array_equal(read.parents, along.parents)
    figure = damage_along_branch(read)
    assert "probability of damage here" in figure.axes[-1].get_ylabel()
    unknown = DamageAlong.of(small_model, small_skeleton, states, None)
    assert unknown.probabilities is None
    assert "largest strain" in damage_along_branch(unknown).axes[-1].get_ylabel()
    (tmp_path / "damage.csv").write_text("x_m,y_m,z_m,parent,strain\n0,0,0,1,0.1\n0,0,1,0,0.1\n")
    with pytest.raises(InputError, match="does not come before its node"):
        DamageAlong.read(tmp_path / "damage.csv")


def test_fitted_weibulls_are_scipy_s():
    """The likeliest shape and scale of each row of strains, which scipy seeks by a simplex."""
    strains = broken_at((3, 9), np.random.default_rng(5))
    for row, shape, scale in zip(strains, *damage._fitted(np.log(strains)), strict=True):
        theirs = scipy.stats.weibull_min.fit(row, shape, floc=0, scale=scale)
        np.testing.assert_allclose([shape, scale], np.array(theirs)[[0, 2]], rtol=1e-3)
        power = row**shape
        assert power @ np.log(row) / power.sum() - 1 / shape == pytest.approx(
            np.log(row).mean(), rel=1e-11)
        assert scale == pytest.approx(power.mean()**(1 / shape))
