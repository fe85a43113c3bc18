"""What a scan leaves open of a branch's shape, carried to its moduli."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.paper_branches import FRACTIONS, measured
from limber.cli.main import call
from limber.core.progress import Progress
from limber.estimation.estimated_branch import Subject, forwards_of, parameter_space
from limber.estimation.fit_assessment import _tell_largest_part
from limber.estimation.fitting.objective import Objective
from limber.estimation.forward.observed_path import ObservedPathForward
from limber.estimation.parameters import Values, open_field, pieces_along
from limber.estimation.settings import FitSpec
from limber.estimation.uncertainty import shape_error as module
from limber.estimation.uncertainty.shape_error import SectionMean, hung_error, shape_error
from limber.geometry.io.skeletons import read_swc
from limber.geometry.skeleton.edits import DeleteBranch, SetRadius
from limber.mechanics.added_masses import HungTwig
from limber.mechanics.model import BranchModel
from limber.recordings.recording import CalibrationEntry
from limber.stages.moduli import other_skeletons
from limber.store import Branch

SETTINGS = FitSpec(hold_out=False, poisson=0.36)
QUANTILE = 2.306 / 1.960  # Student's with 8 shapes over the normal one


@pytest.fixture(scope="module")
def fitted(small, small_bench, small_pull):
    bench, found = small_bench, small_bench.fit([measured(small_pull, 3)], SETTINGS)
    return found.fit.evaluation, found.objective, Subject(
        bench.mesh, small.skeleton, bench.points, bench.weights, bench.model,
        Values(np.full(4, 1e7), 0.36, 900.0))


def _with(monkeypatch, fitted, skeletons, sections=None):
    monkeypatch.setattr(module, "sample_skeletons", lambda *_: skeletons)
    return shape_error(*fitted, np.empty((0, 3)), len(skeletons),
                       sections or _sections(*fitted))


def _sections(evaluation, objective, subject):
    pieces = pieces_along(subject.mesh, subject.skeleton, 12)
    return SectionMean.of(subject.skeleton, subject.mesh, pieces, module.effect_of_pieces(
        evaluation, objective, pieces))


@pytest.mark.parametrize(("size", "part"), [(0.01, np.inf), (0.2, np.inf), (0.05, 0.08)])
def test_thicker_all_along_is_softer_by_the_fourth_power(monkeypatch, fitted, small, size, part):
    """Radii 1 or 20 % off, up or down: each modulus four times as much in the logarithm, as in
    bending stiffness E r^4, which stays what it was; so it does if only a part is thicker."""
    skeleton = small.skeleton
    off = size * np.exp(-0.5 * ((skeleton.arc_length / skeleton.arc_length.max() - 0.6) / part)**2)
    found = _with(monkeypatch, fitted, [
        replace(skeleton, radius=skeleton.radius * np.exp(sign * off)) for sign in 4 * (1, -1)])
    if part == np.inf:
        assert found[0] == pytest.approx(4 * size * QUANTILE, rel=0.1)
    assert found[1].max() < (0.06 if part == np.inf else 0.15) * found[0].max()


@pytest.mark.slow
def test_an_axis_that_is_off_is_not_exact(monkeypatch, fitted, small):
    """0.1 mm aside in the middle shows in the moduli, 0.2 mm twice as much; nothing as nothing."""
    skeleton = small.skeleton
    share = skeleton.arc_length / skeleton.arc_length.max()
    aside = 1e-4 * np.sin(np.pi * share)[:, None] * [0.0, 1.0, 0.0]
    once, twice, never = (_with(monkeypatch, fitted, [
        replace(skeleton, nodes=skeleton.nodes + sign * factor * aside) for sign in 4 * (1, -1)])[0]
        for factor in (1, 2, 0))
    assert 0.002 < once.max() < 0.2
    assert twice == pytest.approx(2 * once, rel=0.1)
    assert never == pytest.approx(0.0, abs=1e-4)


def test_too_few_shapes_say_nothing(fitted):
    """Under 8 there is no answer, and the radii's deviation is taken instead."""
    assert shape_error(*fitted, np.empty((0, 3)), 4, _sections(*fitted)) is None


def test_a_mean_is_over_what_the_pull_bends(fitted, small):
    """Its parts add up, lie around their control point, and none is beyond the grasp."""
    subject, sections = fitted[2], _sections(*fitted)
    along = small.skeleton.arc_length / small.skeleton.arc_length.max()
    assert sections.share.sum(axis=1) == pytest.approx(1.0)
    assert sections.share[:, along > 0.94].sum(axis=1).max() < 0.01
    # By length, the last control point would stand for all of the tip.
    assert sections.share @ along == pytest.approx(FRACTIONS, abs=0.15)
    assert np.all(np.diff(sections.log_second_moment(small.skeleton.radius)) < 0)
    assert SectionMean.of(subject.skeleton, subject.mesh, subject.weights).share[
        :, along > 0.94].sum(axis=1).max() > 0.05


def test_the_largest_part_of_a_wide_interval_is_named():
    """20 % by the scan at the last point: scan better. 10 % in all: no word. Sensors: pull more."""
    def told(sensor: float, geometry: float | None) -> list[str]:
        parts = {"noise of the points": np.array([0.01, sensor])**2}
        if geometry is not None:
            parts["shape of the scan"] = np.array([0.01, geometry])**2
        messages: list[str] = []
        _tell_largest_part(parts, Progress(on_warning=messages.append))
        return messages

    assert told(0.05, 0.08) == []
    assert "point 2" in told(0.05, 0.2)[0] and "scan from more sides" in told(0.05, 0.2)[0]
    assert "more pulls" in told(0.3, 0.2)[0] and "more pulls" in told(0.3, None)[0]


@pytest.mark.slow
def test_a_pull_that_its_force_drives_is_no_exception(monkeypatch, small, small_bench, small_pull):
    """Its forces are unknowns with readings, eliminated: radii 1 % off are still 4 %."""
    pull = measured(small_pull, 3)
    pull = replace(pull, entry=pull.entry.model_copy(update={"drive": "force"}))
    bench, skeleton = small_bench, small.skeleton
    subject = Subject(bench.mesh, skeleton, bench.points, bench.weights, bench.model,
                      Values(np.full(4, 1e7), 0.36, 900.0))
    fit = bench.fit([pull], SETTINGS)
    found = _with(monkeypatch, (fit.fit.evaluation, fit.objective, subject), [
        replace(skeleton, radius=skeleton.radius * (1 + sign * 0.01)) for sign in 4 * (1, -1)])
    assert found[0] == pytest.approx(0.04 * QUANTILE, rel=0.1)
    assert found[1].max() < 0.003


@pytest.mark.slow
def test_a_watched_path_and_an_open_field_are_no_exception(monkeypatch, small, small_bench,
                                                           small_pull):
    """As every recording of a robot is fitted: gripper and cell a little off, the form of the
    field unknown. Radii 1 % off are 4 %."""
    pull = measured(small_pull, 3)
    peak = float(np.linalg.norm(small_pull.wrenches[:, :3], axis=1).max())
    pull = replace(pull, entry=pull.entry.model_copy(update={"calibration": CalibrationEntry(
        force_bias_sigma_n=0.05 * peak, force_drift_sigma_n=0.05 * peak)}))
    bench, skeleton = small_bench, small.skeleton
    field = open_field(bench.mesh, skeleton, bench.weights, FRACTIONS)
    start = Values(np.array(small.young), 0.36, 900.0)
    subject = Subject(bench.mesh, skeleton, bench.points, bench.weights, bench.model, start, field)
    forwards = forwards_of([pull], subject, SETTINGS)
    assert isinstance(forwards[0], ObservedPathForward)
    objective = Objective(forwards, parameter_space(subject, forwards, SETTINGS),
                          force_sigma=[pull.entry.sensor.force_sigma_n])
    evaluation = objective.evaluate(objective.space.pack(start), jacobian=True)
    shapes = [replace(skeleton, radius=skeleton.radius * (1 + sign * 0.01)) for sign in 4 * (1, -1)]
    sections = _sections(evaluation, objective, subject)
    # The states where the fit ended serve: others may not be found.
    monkeypatch.setattr(ObservedPathForward, "simulate", None)
    found = _with(monkeypatch, (evaluation, objective, subject), shapes, sections)
    assert found[0] == pytest.approx(0.04 * QUANTILE, rel=0.1)
    assert found[1].max() < 0.003


@pytest.mark.slow
def test_the_mass_of_twigs_enters_the_interval(small, small_bench, small_pull):
    """A hanging branch with 30 g at its tip: as by pulls of one that carries a tenth more."""
    bench, skeleton = small_bench, small.skeleton
    model = BranchModel(bench.mesh, young=1e7, poisson=0.36, density=900.0, gravity=(0, 0, 9.81),
                        point_masses=[HungTwig(tuple(skeleton.nodes[-1]), 0.03,
                                               tuple(skeleton.nodes[-1]), 3 * ((0.0,) * 3,))],
                        ).as_scanned()
    pull = replace(small_pull, entry=small_pull.entry.model_copy(update={"weightless": False}))
    values = Values(np.array(small.young), 0.36, 900.0)

    def evaluated(hung):
        subject = Subject(bench.mesh, skeleton, bench.points, bench.weights, hung, values)
        forwards = forwards_of([pull], subject, SETTINGS)
        objective = Objective(forwards, parameter_space(subject, forwards, SETTINGS),
                              force_sigma=[0.1])
        return objective, objective.evaluate(objective.space.pack(values), jacobian=True)

    objective, evaluation = evaluated(model)
    residual = evaluated(model.with_hung_mass(1.1))[1].residual
    step = np.linalg.lstsq(evaluation.jacobian, evaluation.residual - residual, rcond=None)[0]
    found = hung_error(evaluation, objective, 0.1)
    assert 1e-3 < found.max() < 0.5
    assert found == pytest.approx(np.abs(step[:4]), rel=0.1, abs=3e-3)
    bare, alone = evaluated(model.without_point_masses())
    assert hung_error(alone, bare, 0.1) is None


# Another likely skeleton of the scan enters the intervals of an estimate.

QUICK = ("--progress", "none", "--quick", "--fractions", "0.2,0.4,0.6,0.8", "--json", "--force")


def estimated(folder, capsys):
    assert call(["estimate", str(folder), *QUICK]) == 0
    capsys.readouterr()
    return json.loads((folder / "estimate.json").read_text())


def thicker(folder):
    """The same branch, of one radius from base to tip that is larger than all of its own."""
    skeleton = read_swc(folder / "skeleton.swc")
    path = skeleton.main_path()
    ends = [tuple(map(float, skeleton.nodes[node])) for node in path[[0, -1]]]
    return skeleton, SetRadius(at=ends[0], to=ends[1], radius=1.05 * float(skeleton.radius.max()))


@pytest.mark.slow
def test_the_moduli_of_another_skeleton_widen_the_intervals(branch_folder, capsys, monkeypatch):
    alone = estimated(branch_folder, capsys)
    assert alone["young_deviation"]["graph"] is None
    skeleton, edit = thicker(branch_folder)
    monkeypatch.setattr(other_skeletons, "_graphs",
                        lambda _: [other_skeletons._Graph(2, 0.5, [edit])])
    both = estimated(branch_folder, capsys)
    # A thicker branch needs a lower modulus: by the fourth power of the radius.
    control = np.interp(both["fractions"], np.linspace(0, 1, len(skeleton.main_path())),
                        skeleton.radius[skeleton.main_path()])
    told = [text for text in both["warnings"] if "alternative 2" in text]
    assert len(told) == 1 and "0.5 times" in told[0]
    likely, values = re.search(r"it is (\S+) times as likely, and gives (.*) MPa", told[0]).groups()
    change = np.log(1e-6 * np.array(alone["young_pa"]) / np.array(values.split(", "), float))
    assert change == pytest.approx(4 * np.log(edit.radius / control), rel=0.4)
    share = float(likely) / (1 + float(likely))
    assert both["young_deviation"]["graph"] == pytest.approx(share**0.5 * change, rel=0.05)
    assert both["young_pa"] == pytest.approx(alone["young_pa"], rel=0.01)
    width, before = (np.diff(np.log(each["young_interval_pa"]), axis=1) for each in (both, alone))
    assert np.all(width > before)
    assert any(cause["cause"] == "skeleton of the scan" for cause in both["causes"])


@pytest.mark.slow
def test_one_without_an_estimate_is_named(branch_folder, capsys, monkeypatch):
    skeleton, _ = thicker(branch_folder)
    far = DeleteBranch(at=tuple(map(float, skeleton.nodes[0] + 50.0)))
    monkeypatch.setattr(other_skeletons, "_graphs",
                        lambda _: [other_skeletons._Graph(2, 0.3, [far])])
    found = estimated(branch_folder, capsys)
    assert found["young_deviation"]["graph"] is None
    assert any("There is no estimate for it" in text for text in found["warnings"])


def test_only_alternatives_that_matter_are_fitted(branch_folder):
    branch = Branch.open(branch_folder)
    here = [0.0, 0.0, 0.1]
    known = [{"probability": 0.6, "edits": []},
             {"probability": 0.2, "edits": [{"do": "delete", "at": here}]},
             {"probability": 0.1, "edits": [{"do": "root", "at": here}]},
             {"probability": 0.02, "edits": [{"do": "root", "at": here}]}]
    branch.made.result["alternatives"] = known
    found = other_skeletons._graphs(branch)
    assert [graph.number for graph in found] == [3]
    assert found[0].odds == pytest.approx(1 / 6)
