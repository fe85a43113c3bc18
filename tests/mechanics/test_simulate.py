"""The command simulate on a small branch folder: frames, keys, failure, the VTU series."""

import json
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from tests.stages.specified import Simulated

from limber.cli.main import call
from limber.core.errors import ConvergenceError, InputError
from limber.core.progress import Progress
from limber.geometry.tets.tet_mesh import TetMesh
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import solve_static
from limber.mechanics.pull_simulation import SimulateSettings
from limber.results.motion_files import read_pc2
from limber.stages.motion.simulate import Simulate
from limber.store import Branch
from limber.store.loading import load_model

KEYS = {"converged", "frame_count", "energy_j", "grasp_force_n", "tip_displacement_m", "min_det_f"}


def test_motion_writes_what_the_design_says(folder):
    """A pull in time: keys, PC2 of the surface, first frame the scan, skipped when current."""
    settings = SimulateSettings(move=(0.02, 0, -0.001), duration=0.2, hold=0.1, grasp_mode="point")
    result = Simulate.of(settings, branch_folder=folder).run()
    assert result.keys() >= KEYS
    assert result["converged"]
    positions, _, _ = read_pc2(folder / "frames" / "simulate.pc2")
    mesh = TetMesh.read(folder / "mesh.vtu")
    surface = np.unique(mesh.surface_faces())
    assert positions.shape == (result["frame_count"], len(surface), 3)
    assert np.abs(positions[0] - mesh.nodes[surface]).max() < 1e-4
    frames = json.loads((folder / "frames" / "simulate.json").read_text())
    assert len(frames["energies_j"]) == frames["frame_count"] == result["frame_count"]
    changed = (folder / "branch.json").stat().st_mtime_ns
    assert Simulate.of(settings, branch_folder=folder).run() == result
    assert (folder / "branch.json").stat().st_mtime_ns == changed


def test_static_force_and_vtu_series(folder):
    """A force in balance: energy grows, the series has each frame with strain and stress."""
    settings = SimulateSettings(kind="static", grasp_force=(1.0, 0, 0), duration=4 / 60, vtu=True,
                                gravity=False, name="pull")
    result = Simulate.of(settings, branch_folder=folder).run()
    frames = json.loads((folder / "frames" / "pull.json").read_text())
    assert np.all(np.diff(frames["energies_j"]) > 0)
    assert result["grasp_force_n"] == pytest.approx([1, 0, 0])
    series = folder / "frames" / "pull" / "pull.pvd"
    entries = list(ElementTree.parse(series).iter("DataSet"))
    assert len(entries) == result["frame_count"]
    last = TetMesh.read(series.parent / entries[-1].get("file"))
    assert last.cell_data["energy_density"].max() > 0
    assert last.cell_data["principal_stress"].shape == (last.tet_count, 3)


def test_torn_branch_exits_with_3_and_keeps_good_frames(folder):
    """A pose that tears the branch: exit code 3, place and reason, frames up to there."""
    settings = SimulateSettings(kind="static", move=(3.0, 0, 0), duration=5 / 60, gravity=False)
    with pytest.raises(ConvergenceError, match=r"at \("):
        Simulate.of(settings, branch_folder=folder).run()
    branch = Branch.open(folder)
    stored = branch.manifest.stages["simulate"].result
    assert not stored["converged"]
    assert stored["frame_count"] >= 2
    assert branch.has("frames/simulate.pc2")
    assert call(["simulate", str(folder), "--kind", "static", "--move", "3", "0", "0",
                 "--duration", "0.0833333", "--no-gravity", "--progress", "none"]) == 3


def test_motion_and_force_at_once_are_refused(folder):
    """Both a motion and a force: exit code 2, nothing written."""
    with pytest.raises(InputError, match="force"):
        Simulate(branch_folder=folder, move=(0.1, 0, 0), grasp_force=(1.0, 0, 0)).run()
    assert not (folder / "frames").exists()


def test_left_out_twigs_hang_on_the_branch(tmp_path):
    """Masses that reconstruct writes for twigs it leaves out weigh on the model of the folder."""
    branch = Branch.create(tmp_path / "twigs.branch")
    with branch.stage("mesh") as stage:
        straight_beam(0.3, 0.006, 0.004).write(stage.path("mesh.vtu"))
        stage.path("point_masses.json").write_text(json.dumps(
            [{"mass_kg": 0.25, "centre_m": [0.1, 0, 0.2], "attached_m": [0, 0, 0.2]}]))
    model = load_model(branch)
    bare = load_model(branch, point_masses=())
    weights = [solve_static(m).require().base_force[2] for m in (model, bare)]
    assert weights[0] - weights[1] == pytest.approx(0.25 * 9.80665, rel=1e-6)


def _replace_mesh(folder, mesh):
    with Branch.open(folder).stage("reconstruct") as stage:
        mesh.write(stage.path("mesh.vtu"))


def _swapped(mesh):
    mesh.tets[5, [0, 1]] = mesh.tets[5, [1, 0]]


def _flat(mesh):
    tet = mesh.tets[5]
    mesh.nodes[tet[3]] = mesh.nodes[tet[:3]].mean(axis=0)


def _loose_end(mesh):
    mesh.point_data["fixed"][:] = 0


def _cell(name, value):
    def spoil(mesh):
        mesh.cell_data[name][3] = value
    return spoil


SPOILT = {
    "inverted": (_swapped, "inverted|negative|inside out"),
    "flat": (_flat, "inverted|volume|flat|inside out"),
    "not fixed": (_loose_end, "fixed"),
    "poisson 0.5": (_cell("poisson", 0.5), "Poisson"),
    "negative young": (_cell("young", -1e9), "young"),
    "no density": (_cell("density", 0.0), "density"),
}


@pytest.mark.parametrize("name", SPOILT)
def test_spoilt_mesh_exits_with_2(folder, name, capsys):
    """Each fault of a mesh ends `limber simulate` with exit code 2 and its reason."""
    spoil, message = SPOILT[name]
    mesh = TetMesh.read(folder / "mesh.vtu")
    mesh = TetMesh(mesh.nodes.copy(), mesh.tets.copy(),
                   {k: v.copy() for k, v in mesh.cell_data.items()},
                   {k: v.copy() for k, v in mesh.point_data.items()})
    spoil(mesh)
    _replace_mesh(folder, mesh)
    assert call(["simulate", str(folder), "--progress", "none"]) == 2
    said = capsys.readouterr()
    assert re.search(message, said.out + said.err)
    assert not (folder / "frames").exists()


def test_two_pieces_exit_with_2(folder, capsys):
    """A second piece beside the branch: exit code 2, with the sizes of both."""
    mesh = TetMesh.read(folder / "mesh.vtu")
    two = TetMesh(
        np.vstack([mesh.nodes, mesh.nodes + [0.1, 0, 0]]),
        np.vstack([mesh.tets, mesh.tets + mesh.node_count]),
        {k: np.concatenate([v, v]) for k, v in mesh.cell_data.items()},
        {k: np.concatenate([v, v]) for k, v in mesh.point_data.items()})
    _replace_mesh(folder, two)
    assert call(["simulate", str(folder), "--progress", "none"]) == 2
    assert "2 separate pieces" in "".join(capsys.readouterr())


def test_grasp_in_the_base_exits_with_2(folder, capsys):
    """A grasp of the fixed base: exit code 2."""
    assert call(["simulate", str(folder), "--grasp-point", "0", "0", "0",
                 "--progress", "none"]) == 2
    assert "fixed base" in "".join(capsys.readouterr())


def test_load_in_wrong_units_warns(folder):
    """A force far too large: a warning that names strain, place and units."""
    said = []
    settings = SimulateSettings(kind="static", grasp_force=(20000.0, 0, 90000.0), duration=2 / 60,
                                gravity=False)
    Simulate.of(settings, branch_folder=folder).run(Progress(on_warning=said.append))
    assert any("units" in message and "at (" in message for message in said), said


def test_frames_say_strain_and_stress_of_each(folder):
    """Largest principal strain and stress per frame, growing with a pull that grows."""
    settings = SimulateSettings(kind="static", grasp_force=(1.0, 0, 0), duration=4 / 60,
                                gravity=False)
    result = Simulate.of(settings, branch_folder=folder).run()
    frames = json.loads((folder / "frames" / "simulate.json").read_text())
    strain = frames["largest_principal_strains"]
    stress = frames["largest_principal_stresses_pa"]
    assert len(strain) == len(stress) == result["frame_count"]
    assert np.all(np.diff(strain) > 0)
    assert stress[-1] == pytest.approx(1e9 * strain[-1], rel=0.3)


def test_series_reads_back_elsewhere(folder):
    """meshio, which is not what wrote them, reads each VTU of the series with all its fields."""
    meshio = pytest.importorskip("meshio")
    settings = SimulateSettings(kind="static", grasp_force=(1.0, 0, 0), duration=2 / 60, vtu=True,
                                gravity=False)
    Simulate.of(settings, branch_folder=folder).run()
    files = sorted((folder / "frames" / "simulate").glob("*.vtu"))
    own = TetMesh.read(folder / "mesh.vtu")
    assert len(files) == 3
    read = meshio.read(files[-1])
    assert read.cells_dict["tetra10"].shape == own.tets.shape
    assert read.points == pytest.approx(own.nodes + read.point_data["displacement"], abs=1e-9)
    assert {"young", "energy_density", "principal_strain", "principal_stress",
            "det_f"} <= set(read.cell_data)


def _frames(folder, name="simulate"):
    return json.loads((folder / "frames" / f"{name}.json").read_text())


def test_a_second_gripper_props_the_branch(folder):
    """A load at half the length, the tip held: the prop carries 5/16 of it (beam theory)."""
    Simulate(branch_folder=folder, kind="static", gravity=False, duration=1 / 60,
             grasp_mode="point", load_at=((0, 0, 0.15, 0.1, 0, 0),), hold_at=((0, 0, 0.3),)).run()
    held = np.array(_frames(folder)["hold_forces_n"])
    assert held.shape == (2, 1, 3)
    assert held[0] == pytest.approx(np.zeros((1, 3)), abs=1e-9)
    assert held[-1, 0, 0] == pytest.approx(-0.1 * 5 / 16, rel=0.03)


def test_pose_and_hold_together_in_motion(folder):
    """One gripper moves, another holds: forces of both are given, the held place stays."""
    Simulate(branch_folder=folder, move=(0.003, 0, 0), hold_at=((0, 0, 0.3),),
             grasp_point=(0, 0, 0.15), duration=0.1, hold=0.05, grasp_mode="point",
             gravity=False).run()
    frames = _frames(folder)
    assert np.shape(frames["hold_forces_n"]) == (frames["frame_count"], 1, 3)
    assert frames["grasp_forces_n"][-1][0] > 0 > frames["hold_forces_n"][-1][0][0]
    mesh = TetMesh.read(folder / "mesh.vtu")
    surface = np.unique(mesh.surface_faces())
    tip = np.linalg.norm(mesh.nodes[surface] - [0, 0, 0.3], axis=1) < 0.01
    positions, _, _ = read_pc2(folder / "frames" / "simulate.pc2")
    assert np.abs((positions[-1] - mesh.nodes[surface])[tip].mean(axis=0)).max() < 3e-4


def test_a_load_grows_as_a_grasp_force_does(folder):
    """The same force by --load-at and by --grasp-force: the same motion."""
    place = {"grasp_point": (0, 0, 0.2), "duration": 0.1, "hold": 0.1, "gravity": False,
             "grasp_mode": "point"}
    Simulate(branch_folder=folder, grasp_force=(0.5, 0, 0), name="force", **place).run()
    Simulate(branch_folder=folder, load_at=((0, 0, 0.2, 0.5, 0, 0),), name="load", **place).run()
    assert _frames(folder, "load")["energies_j"] == pytest.approx(
        _frames(folder, "force")["energies_j"], rel=1e-6)
    assert _frames(folder, "load")["energies_j"][-1] > 0


def test_a_hung_mass_presses_the_branch(folder):
    """One kilogram at the tip of an upright beam: shorter by m g L / (E A) from the start."""
    Simulated(branch_folder=folder, kind="static", mass_at=((0, 0, 0.3, 0.4), (0, 0, 0.3, 0.6)),
              duration=0.0166667, young=5e8, rest_shape=False, grasp_force=(0, 0, 0)).run()
    mesh = TetMesh.read(folder / "mesh.vtu")
    surface = np.unique(mesh.surface_faces())
    positions, _, _ = read_pc2(folder / "frames" / "simulate.pc2")
    middle = np.abs(mesh.nodes[surface, 2] - 0.24) < 1e-6
    moved = (positions[0] - mesh.nodes[surface])[middle, 2].mean()
    own = 900 * 1e-4 * 9.80665 * (0.3 - 0.12) * 0.24 / (5e8 * 1e-4)
    assert moved == pytest.approx(-9.80665 * 0.24 / (5e8 * 1e-4) - own, rel=0.03)


def test_holds_that_overlap_are_refused(folder, capsys):
    """A hold on the grasp itself: exit code 2."""
    assert call(["simulate", str(folder), "--hold-at", "0", "0", "0.2", "--move", "0.01", "0", "0",
                 "--progress", "none"]) == 2
    assert "overlap" in "".join(capsys.readouterr())


def test_a_way_from_a_table_is_followed(folder, tmp_path):
    """A table that moves as --move does, from elsewhere and with its own clock: the same end."""
    way = tmp_path / "robot.csv"
    part = np.linspace(0, 1, 7)
    rows = [f"{5 + p:.9f},{1 + 20 * p:.9f},{2:.1f},{3 - p:.9f}" for p in part]
    way.write_text("\n".join(["t_s,x_mm,y_mm,z_mm", *rows]) + "\n")
    common = ["--kind", "static", "--grasp-mode", "point", "--no-gravity", "--progress", "none"]
    assert call(["simulate", str(folder), "--along", str(way), "--name", "way", *common]) == 0
    assert call(["simulate", str(folder), "--move", "0.02", "0", "-0.001", *common]) == 0
    assert _frames(folder, "way")["energies_j"] == pytest.approx(
        _frames(folder)["energies_j"], rel=1e-6)
    assert call(["simulate", str(folder), "--along", str(way), "--move", "0.02", "0", "0",
                 *common]) == 2


def test_a_pull_is_replayed(folder, tmp_path):
    """Grasp, way, kind and name are the recording's; beside it, not instead of a simulation."""
    from limber.store import Branch

    call(["simulate", str(folder), "--kind", "static", "--duration", "0.0666667",
          "--progress", "none"])
    branch = Branch.open(folder)
    with branch.stage("pull:a") as stage:
        stage.path("pulls/a/pull.toml").write_text(
            "observation = 'none'\n[grasp]\npoint_m = [0.0, 0.0, 0.2]\nradius_m = 0.02\n"
            "mode = 'point'\n")
        stage.path("pulls/a/robot.csv").write_text(
            "t_s,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad\n7,0,0,0.2,0,0,0\n9,0.02,0,0.2,0,0,0\n"
            "127,0,0,0.2,0,0,0\n")
    assert call(["simulate", str(folder), "--pull", "a", "--progress", "none"]) == 0
    frames = _frames(folder, "a")
    assert frames["frame_count"] == 121 and frames["rate"] == pytest.approx(1.0)
    peak = int(np.argmax(frames["energies_j"]))
    assert peak == 2 and frames["energies_j"][-1] < 1e-3 * frames["energies_j"][peak]
    stages = Branch.open(folder).manifest.stages
    assert {"simulate", "replay:a"} <= set(stages)
    assert stages["replay:a"].settings["kind"] == "static"
    for wrong in (["--pull", "b"], ["--pull", "a", "--along", str(tmp_path / "x.csv")]):
        assert call(["simulate", str(folder), *wrong, "--progress", "none"]) == 2


def test_a_plan_takes_the_duration(folder, tmp_path):
    """A table without times, as plans are, is spread over --duration."""
    way = tmp_path / "plan.csv"
    way.write_text("s_m,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad\n0,0,0,0.2,0,0,0\n"
                   "0.01,0.01,0,0.2,0,0.05,0\n0.02,0.02,0,0.199,0,0.1,0\n")
    assert call(["simulate", str(folder), "--along", str(way), "--duration", "0.5",
                 "--hold", "0.1", "--progress", "none"]) == 0
    frames = _frames(folder)
    assert frames["times_s"][-1] == pytest.approx(0.6)
    assert frames["energies_j"][-1] > frames["energies_j"][10] > 0
