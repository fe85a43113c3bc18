"""What was found, in sentences: numbers with units, and what is beyond an arm or the wood."""

from itertools import pairwise

import numpy as np

from limber.core.constants import DATA_COLOURS
from limber.geometry.tets.tree_sweep import straight_beam
from limber.planning.constraints.damage import Strength, assumed
from limber.results.findings import (
    beyond_sentence,
    certificate_sentence,
    modulus_origin,
    modulus_sentence,
    path_sentence,
    peaks_line,
    remarks_on,
    telling_sentence,
)
from limber.results.report import estimate_figures, plan_figures
from limber.results.report.section import two_views
from limber.stages.paths.plan import Plan
from limber.store import Branch

PLAN = {"plan": {"length_m": 0.177, "peak_energy_j": 0.0555, "peak_force_n": 0.657,
                 "peak_strain": 0.0078},
        "baseline": {"length_m": 0.1769, "peak_energy_j": 0.0991, "peak_force_n": 104.0,
                     "peak_strain": 0.0107},
        "energy_saved_percent": 73.94, "length_added_percent": 0.158,
        "certificate": {"gap_percent": 0.61, "full_model": {"gap_percent": 1.23}}}


def test_moduli_stand_with_their_intervals():
    """An open interval says so; of many points the ends of their range stand."""
    told = modulus_sentence({"young_pa": [1.4e9, 3e8],
                             "young_interval_pa": [[1.1e9, 1.8e9], [None, None]]})
    assert "1,400 (1,100 to 1,800), 300 (not determined) MPa (95 % intervals)." in told
    many = {"young_pa": [k * 1e6 for k in range(1, 9)],
            "young_interval_pa": [[k * 9e5, k * 2e6] for k in range(1, 9)]}
    assert "1 (0.9 to 2), 8 (7.2 to 16) MPa" in modulus_sentence(many)
    assert "; assumed)." in modulus_sentence(many, "assumed")


def test_which_of_both_the_pulls_tell_stands_first():
    """E I where the scan leaves the radius open; with what it is good for."""
    one = {"young_interval_pa": [[1e9, 2e9], [1e8, 3e8]],
           "bending_stiffness_interval_nm2": [[1.0, 1.3], [0.1, 0.12]]}
    told = telling_sentence(one)
    assert "the bending stiffness E I to within 13 % and Young's modulus E to within a" in told
    assert "factor of 1.7: good for plans and forces." in told and "need E I alone" in told
    both = telling_sentence(one | {"bending_stiffness_interval_nm2": [[1.0, 3.0]] * 2})
    assert "Both follow alike" in both and "first plan with a wide margin" in both
    assert "with no limit: only an order" in telling_sentence({"young_interval_pa": [[1e9, None]]})


def test_a_path_stands_with_its_numbers_and_what_is_proven():
    """Where nothing is proven, or both paths are one, that is said."""
    assert path_sentence(PLAN) == (
        "The gentle path is 177 mm long, stores at most 55.5 mJ and needs at most 0.657 N; it "
        "saves 73.9 % of the shortest path's energy for +0.16 % of length.")
    assert certificate_sentence(PLAN) == (
        "Its cost is at most 0.6 % on the energy field (proven) and 1.2 % on the full model, by "
        "the field's error at 95 % of the samples, above the least possible.")
    assert certificate_sentence({}) == "No bound on its cost is proven."
    within = {"detour": {"longest_m": 0.1912}}
    assert certificate_sentence(PLAN | within) == (
        "Its energy along the path is at most 0.6 % on the energy field (proven) and 1.2 % on the "
        "full model, by the field's error at 95 % of the samples, above that of the gentlest path "
        "no longer than 191 mm.")
    assert certificate_sentence(within) == "No bound on its energy along the path is proven."
    same = PLAN | {"energy_saved_percent": -0.0, "length_added_percent": 0.0}
    assert path_sentence(same).endswith("no shorter one was found.")
    short = {"plan": {"length_m": 0.2}, "energy_saved_percent": None}
    assert path_sentence(short) == "The gentle path is 200 mm long."


def test_a_force_beyond_an_arm_is_said_beside_it():
    """Of the plan's arm; without one, of the strongest known that cannot carry it."""
    assert remarks_on(PLAN) == {"peak_force_n": "shortest: more than a UR10 carries (98 N)"}
    small = PLAN | {"robot": {"model": "ur3e"}}
    assert "UR3E carries (29 N)" in beyond_sentence(small)
    assert not remarks_on(PLAN | {"robot": {"model": "ur16e"}})
    assert not remarks_on(PLAN | {"robot": {"model": "arms/gone.urdf"}})
    rows = Plan.of(PLAN).comparison()
    assert rows[0][-1] == "beyond reach" and all(len(row) == 5 for row in rows)
    force = next(row for row in rows if row[0].startswith("peak force"))
    assert force[1] == "104" and force[-1] == "shortest: more than a UR10 carries (98 N)"


def test_peaks_of_a_motion_stand_with_the_limits_that_they_exceed():
    """A motion without a gripper has no force; values within reach stand alone."""
    assert peaks_line({"peak_strain": 0.004, "peak_force_n": 20.0}) == (
        "Largest strain 0.4 %; peak force 20 N.")
    assert "break" not in peaks_line({"peak_strain": 0.012, "young_median_pa": 1e8})
    wood = {"young_median_pa": 8e9}
    assert peaks_line(wood | {"peak_strain": 0.012, "peak_force_n": 104.0}) == (
        "Largest strain 1.2 %, over the 0.6 % at which half of such branches break (green wood, "
        "assumed); peak force 104 N, more than a UR10 carries (98 N).")
    assert peaks_line({"peak_strain": 0.004, "peak_force_n": 60.0}, "ur3e").endswith(
        "more than a UR3E carries (29 N).")
    assert peaks_line({"peak_strain": 0.004, "peak_force_n": 0.0}) == "Largest strain 0.4 %."


def test_a_plan_over_the_strength_of_the_wood_says_so():
    """Of the tested or the species' wood, else of green wood, assumed."""
    told = PLAN | {"strength": assumed(0.0078)}
    assert ("shortest and gentle: over the 0.6 % at which half of such branches break (green wood, "
            "assumed)") in beyond_sentence(told)
    ash = PLAN | {"strength": Strength.of_species("ash", 0.0).describe(0.0078)}
    assert beyond_sentence(ash).count("0.67 %") == 1 and "ash" in beyond_sentence(ash)
    gentle = told | {"plan": PLAN["plan"] | {"peak_strain": 0.004}}
    assert "shortest: over the 0.6 %" in beyond_sentence(gentle)
    assert "strain" not in beyond_sentence(PLAN)


def test_a_modulus_says_where_it_is_from(tmp_path):
    """That of a simulated pull of a branch that nobody pulled is assumed."""
    branch = Branch.create(tmp_path / "a.branch")

    def meshed(entry: str, **result: object) -> str:
        with branch.stage(entry) as stage:
            straight_beam(0.3, 0.006, 0.004).write(stage.path("mesh.vtu"))
            stage.result.update(result)
        return modulus_origin(Branch.open(branch.folder))
    assert meshed("mesh") == "assumed"
    assert meshed("estimate") == "estimated"
    with branch.stage("pull:p") as stage:
        stage.path("pulls/p/robot.csv").write_text("t_s\n")
        stage.result["young_true_pa"] = [1e9]
    assert meshed("estimate") == "assumed, from a simulated pull"
    with branch.stage("truth") as stage:
        stage.path("truth/truth.json").write_text("{}")
    assert modulus_origin(Branch.open(branch.folder)) == "estimated"


def test_names_of_parameters_never_overlap():
    """They stand below each other, each with its own line."""
    names = ["form at 0.3", "form of side branches", "density"]
    estimate = {"deviations_before_fit": [0.1] * 5, "covariance": (0.01 * np.eye(5)).tolist(),
                "groups": [0, 1], "parameters": ["E1", "E2", *names]}
    figure = estimate_figures.what_the_pulls_tell(estimate)
    figure.canvas.draw()
    boxes = [label.get_window_extent() for label in figure.axes[0].get_yticklabels()]
    assert len(boxes) == 5 and not any(
        one.overlaps(other) for k, one in enumerate(boxes) for other in boxes[k + 1:])
    bars = figure.axes[0].containers[1].patches
    assert tuple(bars[0].get_facecolor()[:3]) == tuple(
        int(DATA_COLOURS["simulated"][k:k + 2], 16) / 255 for k in (1, 3, 5))


def test_a_flat_search_is_not_drawn():
    """A line that does not move says nothing."""
    def history(*costs: float | None) -> list[dict]:
        return [{"iteration": number, "cost": cost} for number, cost in enumerate(costs)]
    found = plan_figures.searched({"baseline": history(None, 1.0, 1.0),
                                   "plan": history(None, 2.0, 1.0)})
    assert [*found] == ["plan"]
    np.testing.assert_array_equal(found["plan"], [[1, 2], [2, 1]])


def test_numbers_below_a_thin_view_do_not_overlap():
    """A branch is often as thin as one number is wide."""
    tall = np.array([[0.0, 0.0, 0.0], [0.03, 0.12, 0.4], [0.0, 0.02, 0.2]])
    figure, views = two_views(tall)
    for axis, across, _depth in views:
        axis.plot(tall[:, across], tall[:, 2])
    figure.canvas.draw()
    for axis, _across, _depth in views:
        low, high = axis.get_xlim()
        shown = [label.get_window_extent() for label, at in zip(
            axis.get_xticklabels(), axis.get_xticks(), strict=True) if low <= at <= high]
        assert shown and all(one.x1 < other.x0 for one, other in pairwise(shown))
