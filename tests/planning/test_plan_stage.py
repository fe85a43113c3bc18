"""The stages end to end on a small branch by finite elements: files, honesty, refusals."""

import csv
import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.stages.specified import Planned

import limber.planning.make_plan as plan_module
from limber.core.errors import (
    BranchFolderError,
    Cancelled,
    ConvergenceError,
    InputError,
    NoPathError,
)
from limber.core.progress import Progress
from limber.geometry.tets.tet_mesh import TetMesh
from limber.planning.field import sampling
from limber.planning.field.energy_field import EnergyField, fit_field
from limber.planning.goals.goal_kinds import default_goal, hemisphere_goal
from limber.planning.path_on_full_model import resolve_path
from limber.planning.plan_file import doubts_of
from limber.planning.settings import PlanSpec
from limber.results.report.plan_figures import convergence, report_figures, searched
from limber.stages.paths.energy import EnergySettings, SampleEnergy
from limber.store import Branch
from limber.store.loading import load_grasp_model

pytestmark = pytest.mark.usefixtures("rough_plan")
ENERGY = EnergySettings(samples=60)
# No plan made anew because a field of 60 samples is rough.
QUICK = {"iterations": 300, "start_seed": 3}


@pytest.fixture
def copied(planned_branch, tmp_path):
    """A copy of the planned branch that a test may spoil."""
    return shutil.copytree(planned_branch, tmp_path / "copy.branch")


def read_plan(folder, name="there"):
    return json.loads((folder / "plans" / f"{name}.json").read_text())


def test_deformation_aware_path_is_gentler_on_the_full_model(planned_branch):
    """By finite elements, D-RRT* stores less along its way than RRT*, for some more length."""
    plan = read_plan(planned_branch)
    assert plan["energy_saved_percent"] > 10.0
    assert 0.0 <= plan["length_added_percent"] < 40.0
    assert plan["plan"]["peak_energy_j"] <= 1.01 * plan["baseline"]["peak_energy_j"]


def test_reported_energies_are_the_full_models(planned_branch):
    """Energy, force and pose of a path's point are those that the branch model gives there."""
    small_model = load_grasp_model(Branch.open(planned_branch), gravity=True,
                                   progress=Progress(on_warning=pytest.fail))
    plan = read_plan(planned_branch)["plan"]
    poses = np.array(plan["poses"])
    middle = len(poses) // 2
    result = small_model.follow(poses[middle:middle + 1, :3],
                                resolve_path(small_model, poses[:middle, :3],
                                             np.stack([small_model.rest_position, poses[0, :3]])
                                             ).solved.displacements[-1])[0]
    assert small_model.energy(result) == pytest.approx(plan["energies_j"][middle], rel=1e-4)
    assert np.allclose(result.reaction_force, plan["forces_n"][middle], rtol=1e-3, atol=1e-4)
    assert np.allclose(small_model.pose(result.displacement), poses[middle], atol=1e-4)


def test_field_agrees_with_the_full_model_along_the_paths(planned_branch):
    """Along both paths the field was within 15 % (root mean square) and it is reported."""
    plan = read_plan(planned_branch)
    for key in ("baseline", "plan"):
        path = plan[key]
        off = np.array(path["field_energies_j"]) - np.array(path["energies_j"])
        error = np.sqrt(np.mean(off**2) / np.mean(np.square(path["energies_j"])))
        assert path["field_energy_error"] == pytest.approx(error, rel=1e-3)
        assert error < 0.15


def test_files_tell_the_same(planned_branch, small_mesh):
    """Table, plan and frames have the same points; columns and keys are the contract's."""
    plan = read_plan(planned_branch)
    for name, key in (("there", "plan"), ("there-baseline", "baseline")):
        with open(planned_branch / "plans" / f"{name}.csv", newline="") as stream:
            rows = list(csv.DictReader(stream))
        assert list(rows[0]) == ["s_m", "x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad",
                                 "energy_j", "force_n", "strain"]
        assert len(rows) == len(plan[key]["poses"])
        assert float(rows[-1]["s_m"]) == pytest.approx(plan[key]["length_m"], rel=1e-6)
        assert {"length_m", "energy_integral_jm", "energy_sum_nmm", "peak_energy_j",
                "peak_force_n"} <= set(plan[key])
    with open(planned_branch / "plans/there-trees.csv", newline="") as stream:
        nodes = list(csv.DictReader(stream))
    assert {row["planner"] for row in nodes} == {"RRT*"}
    assert sum(row["parent"] == "-1" for row in nodes) == 1 and len(nodes) > 100
    frames = json.loads((planned_branch / "frames/there.json").read_text())
    data = (planned_branch / "frames/there.pc2").read_bytes()
    vertex_count = len(np.unique(small_mesh.surface_faces()))
    assert frames["frame_count"] == len(plan["plan"]["poses"])
    assert len(data) == 32 + 12 * frames["frame_count"] * vertex_count


@pytest.mark.parametrize("place", ["rest", "elsewhere"])
def test_a_plan_whose_goal_is_its_start_saves_nothing(copied, place):
    """Planned at once, without a number for what it saves; the reason is said, and the report
    holds."""
    told, start = [], None
    where = EnergyField.read(copied / "energy.npz").rest
    if place == "elsewhere":
        where = np.array(read_plan(copied)["plan"]["poses"])[-1, :3]
        start = tuple(map(float, where))
    Planned(branch_folder=copied, start=start, goal=tuple(where + [0.004, 0.0, 0.0]),
              inertia=False, name="stay").run(Progress(on_warning=told.append))
    plan = read_plan(copied, "stay")
    assert plan["plan"]["length_m"] < 1e-9 and plan["baseline"]["length_m"] < 1e-9
    for change in ("energy_saved_percent", "peak_energy_saved_percent", "length_added_percent"):
        assert plan[change] is None
    assert len(plan["rounds"]) == 1
    assert [words for words in told if "The start already lies in the goal" in words] == told
    assert report_figures(Branch.open(copied), "stay") == []


def test_folder_can_be_read_again_and_is_not_done_twice(copied):
    """A moved folder opens, its field gives numbers, and the same stage returns at once."""
    branch = Branch.open(copied)
    before = branch.manifest.stages["plan:there"].finished, branch.digest("plans/there.json")
    field = EnergyField.read(branch.path("energy.npz"))
    assert field.energy(field.rest)[0] < 1e-3 * field.samples.energies.max()
    SampleEnergy.of(ENERGY, branch_folder=copied).run()
    Planned(branch_folder=copied, iterations=800, start_seed=3, name="there").run()
    again = Branch.open(copied)
    assert (again.manifest.stages["plan:there"].finished,
            again.digest("plans/there.json")) == before


def test_other_modulus_makes_the_field_stale(copied, monkeypatch):
    """After an estimate changed Young's modulus, planning asks for the energy stage again. It
    corrects the field that is there; only with another density it samples anew."""
    monkeypatch.setattr(sampling, "sample_field", lambda *_, **__: pytest.fail("sampled anew"))
    mesh = TetMesh.read(copied / "mesh.vtu")

    def changed(name):
        with Branch.open(copied).stage("estimate") as stage:
            mesh.with_data(cell_data={name: 2 * mesh.cell_data[name]}).write(
                stage.path("mesh.vtu"))

    changed("young")
    with pytest.raises(BranchFolderError, match="limber energy"):
        Planned(branch_folder=copied, **QUICK, name="other").run()
    old = EnergyField.read(copied / "energy.npz").samples.energies.max()
    SampleEnergy(branch_folder=copied, samples=60).run()
    new = EnergyField.read(copied / "energy.npz")
    assert 0 < new.tested.sum() < 50 and new.errors["energy_error"] < 0.05
    assert new.samples.energies.max() == pytest.approx(2 * old, rel=0.05)
    changed("density")
    with pytest.raises(pytest.fail.Exception, match="sampled anew"):
        SampleEnergy(branch_folder=copied, samples=60).run()


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_refusals_leave_the_folder_as_it_was(copied, monkeypatch):
    """Goals out of reach, over a limit, doubled, or a cancel: an error each, no file changed."""
    monkeypatch.setattr("limber.planning.make_plan._REPLANS", 0)
    before = sorted(p.name for p in copied.rglob("*") if p.name != ".lock")
    with pytest.raises(NoPathError, match=r"misses it by [12]\.\d{3} m"):
        Planned(branch_folder=copied, goal=(2.0, 0.0, 0.0), name="bad").run()
    with pytest.raises(NoPathError, match=r"force .* exceeds the limit 0.01 "):
        Planned(branch_folder=copied, max_force=0.01, iterations=300, name="bad").run()
    with pytest.raises(NoPathError, match=r"in millimetres\?"):
        Planned(branch_folder=copied, goal=(20.0, 0.0, 400.0), name="bad").run()
    with pytest.raises(InputError, match=r"in millimetres\?"):
        Planned(branch_folder=copied, start=(20.0, 0.0, 400.0), name="bad").run()
    with pytest.raises(InputError, match=r"workspace .*in millimetres\?"):
        Planned(branch_folder=copied, workspace=(50.0, -100.0, 0.0, 100.0, 100.0, 500.0),
                  name="bad").run()
    with pytest.raises(InputError, match="tip-goal"):
        Planned(branch_folder=copied, goal=(0, 0, 1), tip_goal=(0, 0, 1), name="bad").run()
    with pytest.raises(InputError, match="outside the sampled region"):
        Planned(branch_folder=copied, start=(1.0, 1.0, 1.0), name="bad").run()
    progress = Progress(lambda fraction, _message, _numbers:
                        progress.cancel() if fraction > 0.05 else None)
    with pytest.raises(Cancelled):
        Planned(branch_folder=copied, **QUICK, name="bad").run(progress)
    assert sorted(p.name for p in copied.rglob("*") if p.name != ".lock") == before


@pytest.mark.slow
def test_stopped_while_the_bound_closes_the_best_so_far_is_kept(copied, monkeypatch):
    """Checked on the full model as any other; the next run is made, not taken for done. A finished
    plan of the name stays."""
    def interrupt(_fraction, message, numbers):
        if message == "bounding the best path" and numbers.get("upper", np.inf) < np.inf:
            raise KeyboardInterrupt

    settings = PlanSpec(iterations=100)
    with pytest.raises(Cancelled, match=r"above the best possible.* stored as plan early"):
        Planned.of(settings, branch_folder=copied, name="early").run(Progress(interrupt))
    early = read_plan(copied, "early")
    assert early["stopped"] and early["plan"]["unsolved_count"] == 0

    asked = []

    def stopped(*_arguments, **_options):
        asked.append(True)
        return SimpleNamespace(summary={"stopped": True})

    monkeypatch.setattr(plan_module, "plan_motion", stopped)
    before = (copied / "plans/there.json").read_text()
    with pytest.raises(Cancelled, match="finished plan there is kept"):
        Planned.of(settings, branch_folder=copied, name="there").run()
    assert (copied / "plans/there.json").read_text() == before
    with pytest.raises(AttributeError):  # the stand-in has no paths: it was asked again
        Planned.of(settings, branch_folder=copied, name="early").run()
    assert len(asked) == 2


def test_a_goal_drawn_from_the_papers_hemisphere(copied):
    """Above the base, no farther than the branch is long, far from rest, the same for a seed."""
    field = EnergyField.read(copied / "energy.npz")
    base, length = np.zeros(3), 0.4

    def drawn(seed, **limits):
        goal = hemisphere_goal(field, base, length, field.limited(**limits), 0.01, seed)
        return goal.region.middle

    first = drawn(1)
    assert np.array_equal(first, drawn(1)) and not np.allclose(first, drawn(2))
    assert np.linalg.norm(first) <= length and first[2] >= 0.0
    away = np.linalg.norm(field.samples.positions - field.rest, axis=1).max()
    assert np.linalg.norm(first - field.rest) >= 0.5 * away and field.region.contains(first)[0]
    with pytest.raises(NoPathError, match="hemisphere"):
        drawn(1, max_energy=1e-6)


@pytest.mark.slow
def test_limits_hold_on_the_full_model(copied):
    """Caps between those that the ends need and those that the free plan takes hold at every pose
    of the motion, approach and return included. In time: test_motion_check and test_plan_cell."""
    plan = read_plan(copied)
    caps = {}
    for name, column in (("max_force", "forces_n"), ("max_strain", "strains")):
        free = np.array(plan["plan"][column])
        free = np.linalg.norm(free, axis=1) if free.ndim == 2 else free
        ends = max(free[0], free[-1])
        caps[name] = float(max(0.5 * (ends + free.max()), 1.05 * ends))
    for name, column in (("max_stress", "stresses_pa"), ("max_axial_force", "axial_forces_n")):
        caps[name] = 1.02 * float(np.abs(plan["motion"][column]).max())
    done = Planned(branch_folder=copied, **caps, **QUICK, inertia=False, name="capped").run()
    motion = read_plan(copied, "capped")["motion"]
    assert np.linalg.norm(motion["forces_n"], axis=1).max() <= caps["max_force"]
    assert max(motion["strains"]) <= caps["max_strain"]
    assert max(motion["stresses_pa"]) <= caps["max_stress"]
    assert np.abs(motion["axial_forces_n"]).max() <= caps["max_axial_force"]
    assert done["margins"]["force"] >= 0.0 and done["rounds"][-1]["broken"] == []


@pytest.mark.slow
def test_plan_that_breaks_a_limit_on_the_full_model_is_refused(copied, monkeypatch):
    """A field that promises half the force: the plan is refused with its place, exit code 3, and
    nothing is written; with the states found added to the field it is planned anew."""
    plan = read_plan(copied)
    cap = 0.7 * float(np.linalg.norm(plan["plan"]["forces_n"], axis=1).max())
    real = EnergyField.read

    def promising(path):
        field = real(path)
        samples = replace(field.samples, energies=0.5 * field.samples.energies,
                          forces=0.5 * field.samples.forces)
        return fit_field(samples, field.chart.pivot, field.chart.radius)

    monkeypatch.setattr(EnergyField, "read", promising)
    monkeypatch.setattr("limber.planning.make_plan._REPLANS", 0)
    with pytest.raises(NoPathError, match=r"force \[N\] .* exceeds .* at \(.*\) m") as refused:
        Planned(branch_folder=copied, max_force=cap, start=tuple(plan["plan"]["poses"][0][:3]),
                  goal=tuple(plan["plan"]["poses"][-1][:3]), name="refused").run()
    assert refused.value.exit_code == 3
    assert not (copied / "plans/refused.json").exists()


def test_a_field_too_coarse_for_the_asked_bound_is_told():
    """With both numbers and what to change; one that is fine enough is not."""
    summary = {"baseline": {"field_energy_error": 0.1, "length_m": 0.1},
               "plan": {"field_energy_error": 0.05, "length_m": 0.11},
               "certificate": {"gap_percent": 1.0}, "planner": "eikonal"}
    told = doubts_of(summary, 3.0)
    assert len(told) == 1 and "5 %" in told[0] and "exceeds the limit of 3 %" in told[0]
    assert doubts_of(summary, 6.0) == []


def test_a_wide_bound_is_named():
    """With the planner that comes closest, unless it is that one."""
    summary = {"baseline": {"field_energy_error": 0.0, "length_m": 0.028},
               "plan": {"field_energy_error": 0.0, "length_m": 0.0024},
               "certificate": {"gap_percent": 411.0}, "planner": "eikonal"}
    wide, = doubts_of(summary, 6.0)
    assert "411.0 % more" in wide and "eikonal" not in wide
    assert "eikonal" in doubts_of(summary | {"planner": "d-rrt-star"}, 6.0)[0]


@pytest.mark.slow
@pytest.mark.usefixtures("coarse_bound")
def test_tip_goal_puts_the_real_tip_there(copied):
    """With a goal for the tip, the full model's tip ends within the tolerance."""
    field = EnergyField.read(copied / "energy.npz")
    wanted = field.tip(default_goal(field, 0.01).region.middle)[0]
    done = Planned(branch_folder=copied, tip_goal=tuple(wanted), iterations=300, name="tip").run()
    assert np.linalg.norm(np.array(done["plan"]["tip_end_m"]) - wanted) <= 0.01 * 1.001


def test_path_that_the_branch_cannot_follow_is_an_error(small_model):
    """A path that tears the branch ends in ConvergenceError and not in numbers."""
    away = small_model.rest_position + np.linspace(0, 1, 8)[:, None] * np.array([0, 0, 2.0])
    with pytest.raises(ConvergenceError, match="no acceptable solution"):
        resolve_path(small_model, away, small_model.rest_position[None]).require()


@pytest.mark.slow
def test_figures_draw(planned_branch, tmp_path):
    """The report's figures can be drawn, each with a caption."""
    for number, (figure, caption) in enumerate(report_figures(Branch.open(planned_branch),
                                                              "there")):
        figure.savefig(tmp_path / f"{number}.png")
        assert caption and (tmp_path / f"{number}.png").stat().st_size > 5000


def test_a_planner_that_found_its_first_path_late_is_drawn():
    """Grids without a path yet have no cost: the curve begins where there is one."""
    histories = {"baseline": [], "plan": [
        {"iteration": 1, "cost": None}, {"iteration": 2, "cost": 2.0},
        {"iteration": 3, "cost": 1.0}]}
    (line,) = convergence(searched(histories)).axes[0].lines
    assert line.get_xdata().tolist() == [2, 3] and line.get_ydata().tolist() == [2.0, 1.0]
