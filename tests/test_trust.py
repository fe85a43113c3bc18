"""Files of a branch folder with right checksums and wrong content: errors, never tracebacks."""

import importlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from limber.core.errors import InputError
from limber.core.files.atomic import file_digest
from limber.core.settings import checked_settings
from limber.geometry.settings import ReconstructSettings
from limber.geometry.tets.tet_mesh import TetMesh
from limber.recordings.image_folders import copy_rgbd
from limber.recordings.settings import ImportSpec
from limber.results.scene.animation import scene_data
from limber.stages.moduli.predict import Predict
from limber.store import Branch
from limber.store.loading import load_mesh, load_point_masses

EXAMPLE = Path(__file__).parents[1] / "blend_files" / "bending_branch"


@pytest.fixture
def damaged(tmp_path):
    """Gives a branch in which one file is another, with the checksum that goes with it."""
    folder = shutil.copytree(EXAMPLE, tmp_path / "a.branch")

    def make(name: str, content: bytes) -> Branch:
        (folder / name).write_bytes(content)
        manifest = json.loads((folder / "branch.json").read_text())
        manifest["files"][name] = {"sha256": file_digest(folder / name), "bytes": len(content),
                                   "stage": "estimate"}
        (folder / "branch.json").write_text(json.dumps(manifest))
        return Branch.open(folder)
    return make


def _changed(name: str, *path: object, value: object) -> bytes:
    content = json.loads((EXAMPLE / name).read_text())
    place = content
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return json.dumps(content).encode()


@pytest.mark.parametrize(("name", "path", "value"), [
    ("plans/to-goal.json", ["goal"], []), ("plans/to-goal.json", ["paths_on_field"], True),
    ("plans/to-goal.json", ["detour"], True), ("plans/to-goal.json", ["certificate"], True),
    ("plans/to-goal.json", ["energy_saved_percent"], "12"),
    ("plans/to-goal.json", ["plan", "length_m"], "x"),
    ("frames/to-goal.json", ["rate"], -1), ("frames/to-goal.json", ["energies_j"], [1.0, None]),
    ("frames/to-goal.json", ["frame_count"], 10**30)])
def test_json_of_plans_and_frames(damaged, name, path, value):
    """What a scene shows of them is checked when they are read."""
    with pytest.raises(InputError, match=Path(name).name):
        scene_data(damaged(name, _changed(name, *path, value=value)))


@pytest.mark.parametrize("name", ["frames/to-goal.npz", "frames/to-goal.json", "energy.npz",
                                  "mesh.vtu", "plans/to-goal.csv", "frames/to-goal.pc2"])
def test_files_of_noise(damaged, name):
    """Bytes that are nothing at all."""
    noise = np.random.default_rng(3).bytes(500)
    with pytest.raises(InputError, match=Path(name).name):
        scene_data(damaged(name, noise))


@pytest.mark.parametrize(("path", "value"), [
    (["fractions"], [0.2]), (["young_pa", 1], -5.0), (["covariance", 2], None),
    (["covariance", 0, 0], "0.01"), (["young_pa", 0], True), (["loss_m2"], "1e-6"),
    (["poisson"], 3), (["groups", 0], 99), (["causes"], [1])])
def test_an_estimate_that_does_not_fit_itself(damaged, path, value):
    """`limber predict` and the report refuse it, and say where."""
    branch = damaged("estimate.json", _changed("estimate.json", *path, value=value))
    with pytest.raises(InputError, match=r"estimate\.json"):
        Predict(branch_folder=branch.folder, weight=1.0).run()


@pytest.mark.parametrize("content", [
    [{"mass_kg": -1, "attached_m": [0, 0, 0]}], [{"mass_kg": 1}], {"a": 1},
    [{"mass_kg": 1, "attached_m": [0, 0, None]}], [{"mass_kg": 1, "attached_m": [0, 0]}]])
def test_point_masses(damaged, content):
    """No negative mass, no place without three numbers."""
    with pytest.raises(InputError, match=r"point_masses\.json"):
        load_point_masses(damaged("point_masses.json", json.dumps(content).encode()))


def test_a_mesh_whose_data_are_no_numbers(damaged):
    """A modulus of NaN, and a tetrahedron of a node that is not there."""
    mesh = TetMesh.read(EXAMPLE / "mesh.vtu")
    for wrong in (mesh.with_data(cell_data={"young": np.full(mesh.tet_count, np.nan)}),
                  TetMesh(mesh.nodes, mesh.tets + mesh.node_count - 5)):
        path = EXAMPLE.parent / "none"
        with pytest.raises(InputError):
            wrong.check(path)
    noise = (EXAMPLE / "mesh.vtu").read_bytes()[:-3000]
    with pytest.raises(InputError, match=r"mesh\.vtu"):
        load_mesh(damaged("mesh.vtu", noise))


def test_an_alignment_that_is_no_turn(damaged):
    """A manifest's turn has rows at right angles, its scale is above 0."""
    for key, value in (("scale", 0.0), ("rotation", [[0, 0, 0]] * 3)):
        content = _changed("branch.json", "alignment", key, value=value)
        with pytest.raises(InputError, match=r"branch\.json"):
            damaged("branch.json", content)


@pytest.mark.parametrize(("name", "value"), [
    ("up", (0.0, 0.0, 0.0)), ("up", (np.nan, 0.0, 1.0)), ("up", (np.inf, 0.0, 0.0)),
    ("camera_at", (np.nan, 0.0, 1.0)), ("young", np.inf)])
def test_options_are_finite_and_directions_have_a_length(name, value):
    """`--up 0 0 0`, `--camera-at nan` and their like are refused by name."""
    with pytest.raises(InputError, match=f"--{name.replace('_', '-')}"):
        checked_settings(ReconstructSettings, {name: value})


@pytest.mark.parametrize(("model", "values", "told"), [
    ("geometry:ReconstructSettings", {"young": 9.0}, "for 9 GPa write 9e9"),
    ("geometry:ReconstructSettings", {"density": 0.9}, "for 0.9 g/cm^3 write 900"),
    ("geometry:MeshSurfaceSettings", {"young": 1e-300}, "between 1 kPa and 100 GPa"),
    ("geometry:MeshSurfaceSettings", {"density": 1e5}, "between 50 and 3000"),
    ("mechanics:SimulateSettings", {"young": 1e12}, "between 1 kPa and 100 GPa"),
    ("estimation:FitSpec", {"young": 0.1}, "for 0.1 GPa write 0.1e9"),
    ("estimation:FitSpec", {"density": 900e3}, "between 50 and 3000"),
    ("estimation:PredictSettings", {"weight": 1e29}, "no branch bears 1e+29 N"),
    ("estimation:PredictSettings", {"load": (0.0, 0.0, -250e3)}, "for -250000 mN write -250"),
    ("mechanics:SimulateSettings", {"grasp_force": (1e30, 0.0, 0.0)}, "no branch bears"),
    ("mechanics:SimulateSettings", {"load_at": ((0, 0, 0.3, 0, 0, 1e6),)}, "no branch bears"),
    ("mechanics:SimulateSettings", {"mass_at": ((0, 0, 0.3, 1e5),)}, "no branch bears"),
    ("stages.motion.load:ApplyLoads", {"branch_folder": "a", "wind": (300.0, 0.0, 0.0)},
     "83.3333 m/s would be 300"),
    ("stages.motion.load:ApplyLoads", {"branch_folder": "a", "fruit": ((0, 0, 0.3, 1e20),)},
     "no branch bears"),
    ("recordings:ImportSettings", {"weight": 1e6}, "for 1e+06 mN write 1000"),
    ("estimation:VirtualPullSettings", {"young": (1e8, 9.0)}, "for 9 GPa write 9e9")])
def test_moduli_and_densities_are_those_of_matter(model, values, told):
    """GPa for Pa and g/cm^3 for kg/m^3: the likely slip is named."""
    part, name = model.split(":")
    place = part if "." in part else f"{part}.settings"
    settings = getattr(importlib.import_module(f"limber.{place}"), name)
    with pytest.raises(InputError) as refused:
        checked_settings(settings, values)
    assert told in str(refused.value)


def test_lists_of_a_recording_stay_in_its_folder(tmp_path):
    """A depth list that names a file elsewhere is refused; so are turns of length 0."""
    (tmp_path / "in" / "depth").mkdir(parents=True)
    for name in ("in/depth/1.png", "in/depth/2.png", "secret.png"):
        Image.fromarray(np.full((4, 6), 700, np.uint16)).save(tmp_path / name)
    source = tmp_path / "in"
    (source / "calibration.txt").write_text("40 40 3 2")
    (source / "depth.txt").write_text("1.0 depth/1.png\n2.0 ../secret.png\n")
    with pytest.raises(InputError, match="outside the recording's folder"):
        copy_rgbd(source, tmp_path / "out", ImportSpec())
    (source / "depth.txt").unlink()
    (source / "groundtruth.txt").write_text("1 0 0 0 0 0 0 0\n2 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match="quaternion"):
        copy_rgbd(source, tmp_path / "out", ImportSpec())
