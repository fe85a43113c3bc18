"""The commands virtual-pull and estimate on a branch folder."""

import json
import shutil

import numpy as np
import pytest
from tests.stages.specified import Fit, SpecifiedPull

from limber.cli.main import call
from limber.core.errors import Cancelled, InputError
from limber.core.progress import SILENT, Progress
from limber.estimation import fit
from limber.estimation.fitting import objective
from limber.estimation.parameters import Values
from limber.estimation.settings import EstimateSettings, FitSpec
from limber.geometry.settings import ReconstructSettings
from limber.geometry.tets.tet_mesh import TetMesh
from limber.recordings.recording import read_pull
from limber.results.report.estimate_figures import report_figures
from limber.stages.moduli.estimate import EVALUATIONS, EstimateYoung, follow
from limber.store import Branch
from limber.store.loading import fit_spec, load_estimated_subject, stiffness_deviation

QUICK = FitSpec(key_frames=6, mesh_check=False, shapes=0)
TRUTH = np.array([40e6, 22e6, 12e6, 3e6])


def test_virtual_pull_is_a_recording_with_its_truth(branch_folder):
    """It starts at rest, costs work, comes from a finer mesh and says what was true."""
    pull = read_pull(branch_folder / "pulls" / "pull-1")
    assert np.allclose(pull.poses[0, :3], pull.entry.grasp.point_m, atol=1e-9)
    travel = np.linalg.norm(pull.poses[-1, :3] - pull.poses[0, :3])
    assert 0.25 < travel / (0.92 * 0.40) < 0.45
    truth = pull.entry.truth
    assert truth["young_pa"] == TRUTH.tolist()
    assert truth["tet_count"] > 1.1 * TetMesh.read(branch_folder / "mesh.vtu").tet_count
    again = SpecifiedPull(branch_folder=branch_folder, name="again", young=tuple(TRUTH),
                          poisson=0.36, frames=12, seed=4, phase=0.5).run()
    assert again["frame_count"] == 12
    same = read_pull(branch_folder / "pulls" / "again")
    assert np.allclose(same.wrenches[:, :3], pull.wrenches[:, :3], atol=1e-6)


def test_a_ratio_that_was_given_counts_as_measured(branch_folder):
    for value, sigma in ((0.35, 0.05), (0.41, 0.03)):
        with Branch.open(branch_folder).stage("reconstruct", ReconstructSettings(poisson=value)):
            pass
        assert fit_spec(Branch.open(branch_folder), EstimateSettings()).poisson_sigma == sigma


@pytest.mark.slow
def test_estimate_from_the_command_line(branch_folder, capsys, monkeypatch):
    """The JSON line has the promised keys, the mesh the new modulus; a second call does nothing."""
    def run(*more):
        assert call(["estimate", str(branch_folder), "--json", "--progress", "none", *more]) == 0
        return json.loads(capsys.readouterr().out.strip().splitlines()[-1])

    line = run()
    assert line["status"] == "done" and line["converged"] and line["method"] == "gauss-newton"
    assert {"young_pa", "young_interval_pa", "poisson", "loss_m2", "forward_count"} <= set(line)
    young = np.array(line["young_pa"])
    assert np.abs(young / TRUTH - 1).max() < 0.35
    mesh = TetMesh.read(branch_folder / "mesh.vtu")
    assert mesh.cell_data["young"].max() < 1.02 * young.max()
    assert mesh.cell_data["young"].min() > 0.98 * young.min()
    assert not (branch_folder / EVALUATIONS).exists()
    monkeypatch.setattr(fit, "fit_branch", lambda *_, **__: pytest.fail("it was fitted again"))
    assert run()["young_pa"] == line["young_pa"]
    branch = Branch.open(branch_folder)
    stored = json.loads(branch.path("estimate.json").read_text())
    assert stored["truth"]["young_pa"] == TRUTH.tolist()
    assert len(stored["history"]) == stored["forward_count"]
    captions = [caption for figure, caption in report_figures(stored)
                if figure.axes and figure.axes[0].has_data()]
    assert len(captions) == 6
    parts = stored["young_deviation"]
    assert parts["geometry"] is None and max(parts["mesh"]) < 0.2
    assert "have no stated deviation" in captions[0]


def test_forces_are_as_well_known_as_the_bending_stiffness(branch_folder):
    """A radius of the scan cancels: half width .2 in log E I where E has .6; without it E's."""
    known = {"method": "gauss-newton", "poisson": 0.35, "loss_m2": 1e-5, "forward_count": 9,
             "converged": True, "groups": [0, 1], "parameters": ["E1", "E2"], "history": [],
             "covariance": [[0.1, 0.0], [0.0, 0.1]], "deviations_before_fit": [], "pulls": [],
             "fractions": [0.3, 0.6], "young_pa": [1e8, 1e8], "control_points_m": [[0, 0, 0.1]] * 2,
             "young_interval_pa": [[1e8 * np.exp(-0.6), 1e8 * np.exp(0.6)]] * 2}
    of_bending = [[0.3 * np.exp(-0.2), 0.3 * np.exp(0.2)], [None, None]]
    for content, width in ((known, 0.6), (known | {"bending_stiffness_nm2": [0.3, 0.3],
                                                   "bending_stiffness_interval_nm2": of_bending},
                                          0.2)):
        branch = Branch.open(branch_folder)
        with branch.stage("estimate") as stage:
            stage.path("estimate.json").write_text(json.dumps(content))
        assert stiffness_deviation(branch) == pytest.approx(width / 1.96)


@pytest.mark.slow
def test_a_stopped_estimate_keeps_the_best_and_goes_on(branch_folder):
    """Cancelled in the middle: exit 130's error, estimate.json unfinished, mesh untouched; asked
    to, the next run takes the evaluations over.
    """
    before = TetMesh.read(branch_folder / "mesh.vtu").cell_data["young"]

    calls = 0

    def stop_at_the_fourth(_fraction, message, _numbers):
        nonlocal calls
        calls += message == "fitting"
        if calls >= 4:
            raise Cancelled

    with pytest.raises(Cancelled, match="resume"):
        Fit.of(QUICK, branch_folder=branch_folder).run(Progress(stop_at_the_fourth))
    kept = json.loads((branch_folder / "estimate.json").read_text())
    assert kept["stopped"] and not kept["converged"]
    assert np.array_equal(TetMesh.read(branch_folder / "mesh.vtu").cell_data["young"], before)
    warnings: list[str] = []
    result = Fit.of(QUICK, branch_folder=branch_folder,
                    resume=True).run(Progress(on_warning=warnings.append))
    assert any("Resumed" in warning for warning in warnings)
    assert result["converged"] and not result["stopped"]


@pytest.mark.slow
def test_an_estimate_without_budget_goes_on_when_it_is_run_again(branch_folder, monkeypatch):
    """The best so far with its reason, and the mesh untouched; the next run ends as any does."""
    before = TetMesh.read(branch_folder / "mesh.vtu").cell_data["young"]
    monkeypatch.setattr(objective, "WORK_LIMIT", 1.0)
    short = Fit.of(QUICK, branch_folder=branch_folder).run()
    assert not short["converged"] and "not ended" in short["warnings"][-1] and not short["causes"]
    assert np.array_equal(TetMesh.read(branch_folder / "mesh.vtu").cell_data["young"], before)
    monkeypatch.undo()
    found = Fit.of(QUICK, branch_folder=branch_folder).run()
    assert found["converged"] and any("Resumed: 1 " in each for each in found["warnings"])
    assert found["young_pa"] == pytest.approx(
        Fit.of(QUICK, branch_folder=branch_folder, force=True).run()["young_pa"], rel=0.01)


@pytest.mark.slow
def test_what_a_killed_estimate_left_changes_no_digit(branch_folder, tmp_path):
    """Killed at its third evaluation, or at its end before anything was entered: the next run
    ends as one in a folder where nothing had happened.
    """
    settings = FitSpec(key_frames=4, shapes=0)
    clean, early, late = (tmp_path / name for name in ("clean", "early", "late"))
    for folder in (clean, early, late):
        shutil.copytree(branch_folder, folder)
    expected = Fit.of(settings, branch_folder=clean).run()
    calls = 0

    class Killed(BaseException):
        """Nothing catches it, as nothing catches SIGKILL."""

    def kill(share: float, message: str, _numbers: dict) -> None:
        nonlocal calls
        calls += message == "fitting"
        if calls >= 3:
            raise Killed

    with pytest.raises(Killed):
        Fit.of(settings, branch_folder=early).run(Progress(kill))
    assert (early / EVALUATIONS).exists()

    def kill_late(share: float, _message: str, _numbers: dict) -> None:
        if share > 0.9:
            raise Killed

    with pytest.raises(Killed):
        Fit.of(settings, branch_folder=late).run(Progress(kill_late))
    for folder in (early, late):
        found = Fit.of(settings, branch_folder=folder).run()
        for name in ("young_pa", "young_interval_pa", "loss_m2"):
            assert np.array_equal(found[name], expected[name]), (folder, name)


def test_pulls_that_are_not_there(branch_folder):
    """A name that does not exist is answered with those that do."""
    with pytest.raises(InputError, match="pull-1"):
        EstimateYoung(branch_folder=branch_folder, pull=("pull-9",)).run()


def test_without_force_the_estimate_refuses(branch_folder):
    """Through the whole stage: positions alone are refused, and nothing is written."""
    SpecifiedPull(branch_folder=branch_folder, name="blind", young=tuple(TRUTH), frames=5, seed=1,
                phase=0.5).run()
    robot = branch_folder / "pulls" / "blind" / "robot.csv"
    lines = [",".join(line.split(",")[:7]) for line in robot.read_text().splitlines()]
    target = branch_folder.parent / "blind"
    target.mkdir()
    for file in (branch_folder / "pulls" / "blind").iterdir():
        (target / file.name).write_bytes(file.read_bytes())
    (target / "robot.csv").write_text("\n".join(lines) + "\n")
    assert call(["import-pull", str(branch_folder), str(target), "--name", "deaf",
                 "--progress", "none"]) == 0
    with pytest.raises(InputError, match="soft or stiff"):
        EstimateYoung(branch_folder=branch_folder, pull=("deaf",)).run()
    assert not (branch_folder / "estimate.json").exists()


@pytest.mark.slow
def test_following_a_pull(branch_folder):
    """Frame by frame the intervals narrow; it ends at what all frames together give."""
    SpecifiedPull(branch_folder=branch_folder, name="long", young=tuple(TRUTH), poisson=0.36,
                frames=24, seed=6, phase=0.5, position_noise=5e-4).run()
    # What follows frame by frame knows one form of the field.
    settings = QUICK.model_copy(update={"pull": ("long",), "field": "inverse_distance"})
    result = follow(Fit.of(settings, branch_folder=branch_folder), SILENT, training_count=12,
                    pace=0)
    assert result["frame_count"] == 24 and result["method"] == "online"
    stored = json.loads((branch_folder / "estimate-online.json").read_text())
    widths = [np.log(np.array(state["young_interval_pa"])) @ [-1, 1] for state in stored["history"]]
    assert np.all(widths[-1] < 0.3 * widths[5])
    half = np.log(np.array(result["young_interval_pa"])) @ [-0.5, 0.5]
    batch = np.array(Fit.of(settings, branch_folder=branch_folder).run()["young_pa"])
    assert np.all(np.abs(np.log(np.array(result["young_pa"]) / batch)) < half)
    assert np.all(np.abs(np.log(np.array(result["young_pa"]) / TRUTH)) < 2 * half + 0.03)


@pytest.mark.slow
def test_a_hollow_branch_has_stiffer_wood_and_the_same_bending_stiffness(branch_folder):
    """The mesh gets the modulus of solid sections; what is computed on it stays the same."""
    solid = Fit.of(QUICK, branch_folder=branch_folder).run()
    mesh = TetMesh.read(branch_folder / "mesh.vtu").cell_data["young"]
    hollow = Fit.of(QUICK.model_copy(update={"pith_radius": 6e-3}),
                    branch_folder=branch_folder).run()
    wood = np.array(hollow["young_pa"]) / np.array(solid["young_pa"])
    # The radius falls from 10 to 8 mm.
    assert np.all(wood > 1 / (1 - 0.6**4) - 0.02) and np.all(wood < 1 / (1 - 0.75**4) + 0.02)
    # Hollow and solid share out differently along a control point's part, most at the tip.
    assert hollow["bending_stiffness_nm2"][:3] == pytest.approx(
        solid["bending_stiffness_nm2"][:3], rel=0.03)
    assert hollow["bending_stiffness_nm2"][3] == pytest.approx(
        solid["bending_stiffness_nm2"][3], rel=0.06)
    again = TetMesh.read(branch_folder / "mesh.vtu").cell_data["young"]
    assert again == pytest.approx(mesh, rel=0.12)
    known = json.loads((branch_folder / "estimate.json").read_text())
    subject = load_estimated_subject(Branch.read(branch_folder), known, gravity=True)
    assert subject.young(Values(np.array(known["young_mesh_pa"]), 0.36, 900.0,
                                form=tuple(known["field_form"]))) == pytest.approx(again)
