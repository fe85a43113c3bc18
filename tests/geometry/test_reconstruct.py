"""The commands reconstruct, generate and mesh, on real scans and on what they must refuse."""

import json
import shutil

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tests.stages.specified import Simulated

from limber.cli.main import call
from limber.core.errors import Cancelled, InputError, PartlyFailedError
from limber.core.progress import Progress
from limber.geometry import reconstruction
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.generated import generate_branch
from limber.geometry.io.clouds import read_points
from limber.geometry.io.skeletons import read_swc
from limber.geometry.reconstruction import ReconstructSettings, reconstruct_cloud
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics import solve_static
from limber.mechanics.settings import SimulateSpec
from limber.stages.shape.generate import write_generated
from limber.stages.shape.mesh import Mesh
from limber.stages.shape.reconstruct import (
    CLASSES_COMMENT,
    Reconstruct,
    _place_of_classes,
    _without,
)
from limber.store import Branch
from limber.store.loading import load_model

KEYS = ("point_count", "node_count", "branch_count", "length_m", "radius_min_m", "radius_max_m",
        "surface_volume_m3", "mesh_volume_m3", "tet_count", "watertight", "clamped_radius_count",
        "peak_memory_mb")


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    """A generated branch on disk, reconstructed."""
    folder = tmp_path_factory.mktemp("generated")
    branch = generate_branch(5, fork_count=2, length=0.5, point_spacing=0.004)
    write_generated(branch, folder)
    result = Reconstruct(cloud=folder / "cloud.ply", output=folder / "g.branch").run()
    return folder, branch, result


def test_result_files_and_keys(generated):
    """Every file of the design is there and every promised number."""
    folder, _, result = generated
    assert not set(KEYS) - set(result)
    opened = Branch.open(folder / "g.branch")
    for name in ("cloud.ply", "skeleton.swc", "surface.ply", "mesh.vtu", "skeleton.csv"):
        assert opened.has(name)
    mesh = TetMesh.read(opened.path("mesh.vtu"))
    assert mesh.is_quadratic and set(mesh.cell_data) >= {"young", "poisson", "density"}


def test_the_unit_of_a_scan_is_asked_for(tmp_path, capsys):
    """Millimetres without --unit, before any work; what is stated is taken up to 100 m."""
    z = np.linspace(0, 40.0, 400)
    scan = tmp_path / "twig.xyz"
    np.savetxt(scan, np.column_stack([np.cos(9 * z), np.sin(9 * z), z]))
    given = ["reconstruct", str(scan), "-o", str(tmp_path / "twig.branch"), "--json"]
    assert call(given) == 2
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert "40 m long" in told["error"]
    assert {("unit", "mm"), ("unit", "m")} <= {
        (one["option"], one["value"]) for one in told["remedies"]}
    assert not (tmp_path / "twig.branch").exists()
    for scale, text in ((3.0, "No plant"), (1.0, "unit")):
        cloud = Cloud(np.loadtxt(scan) * scale)
        with pytest.raises(InputError, match=text):
            reconstruct_cloud(cloud, ReconstructSettings(**{"unit": "m"} if scale > 1 else {}))


@pytest.mark.slow
def test_an_open_root_is_asked_for_and_leaves_an_earlier_result_whole(tmp_path, capsys):
    """An even rod that lies flat: two ends, each offered in the unit of the file."""
    rng = np.random.default_rng(4)
    along, turn = 400 * rng.random(800), 2 * np.pi * rng.random(800)
    scan, folder = tmp_path / "rod.xyz", tmp_path / "rod.branch"
    np.savetxt(scan, np.column_stack([along, 10 * np.cos(turn), 10 * np.sin(turn)]))
    given = ["reconstruct", str(scan), "-o", str(folder), "--unit", "mm", "--json"]
    assert call([*given, "--root", "auto"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["root_probability"] < 0.8 and "uncertain" in " ".join(told["warnings"])
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert call(given) == 2
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    ends = sorted(one["value"][0] for one in told["remedies"] if isinstance(one["value"], list))
    assert ends == pytest.approx([0, 400], abs=40)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_truth_is_carried_in_the_branch_frame(generated):
    """The true skeleton lies on the reconstructed one after alignment, and Young's modulus too."""
    folder, branch, _ = generated
    opened = Branch.open(folder / "g.branch")
    truth = read_swc(opened.path("truth/skeleton.swc"))
    found = read_swc(opened.path("skeleton.swc"))
    distance, _ = cKDTree(found.nodes).query(truth.nodes)
    assert np.median(distance) < 0.004
    told = json.loads(opened.path("truth/truth.json").read_text())
    np.testing.assert_allclose(told["young_pa"], branch.young)


def test_alignment_undoes(generated):
    """The aligned cloud goes back to the file's coordinates."""
    folder, branch, _ = generated
    opened = Branch.open(folder / "g.branch")
    back = opened.manifest.alignment.undo(read_points(opened.path("cloud.ply")).points)
    distance = np.abs(back[:, None] - branch.cloud.points[None, :50]).sum(axis=2).min(axis=0)
    assert np.median(distance) < 1e-6


def test_second_run_computes_nothing(generated, monkeypatch):
    """Nothing has changed: the stored result is returned."""
    folder, _, result = generated
    monkeypatch.setattr(reconstruction, "reconstruct_cloud",
                        lambda *_, **__: pytest.fail("it ran again"))
    assert Reconstruct(cloud=folder / "cloud.ply", output=folder / "g.branch").run() == result


def test_gravity_turns_with_the_branch(generated):
    """Turned upright, gravity keeps its size and its angle to the branch."""
    _, _, result = generated
    assert np.linalg.norm(result["gravity_m_s2"]) == pytest.approx(9.80665)


@pytest.mark.slow
def test_coffeetree(coffeetree, tmp_path):
    """The real branch: forks found, valid surface, a mesh of the surface's volume."""
    result = Reconstruct(cloud=coffeetree, output=tmp_path / "c.branch").run()
    assert 7 <= result["branch_count"] <= 14
    assert 4.5 < result["length_m"] < 5.6
    assert result["radius_max_m"] < 0.03
    assert result["watertight"] and result["surface_check"]["self_intersection_count"] == 0
    assert result["mesh_volume_m3"] == pytest.approx(result["surface_volume_m3"], rel=0.03)
    assert 2000 < result["tet_count"] < 6000


def test_own_skeleton_skips_ours(generated, tmp_path):
    """A given skeleton is used as it is."""
    folder, branch, _ = generated
    result = Reconstruct(cloud=folder / "cloud.ply", output=tmp_path / "o.branch",
                         skeleton=folder / "truth_skeleton.swc").run()
    assert result["contraction_status"] == "skeleton given"
    assert result["length_m"] == pytest.approx(branch.skeleton.length, rel=1e-4)


@pytest.mark.slow
def test_left_out_twigs_become_masses(generated, tmp_path):
    """Thin twigs leave the mesh, and their mass is written; a later run that keeps all
    twigs takes their masses away.
    """
    folder, _, full = generated
    place = tmp_path / "t.branch"
    result = Reconstruct(cloud=folder / "cloud.ply", output=place, twig_radius=0.0055).run()
    masses = json.loads((place / "point_masses.json").read_text())
    assert len(masses) == result["left_out_twigs"] == 2
    whole = 900 * full["mesh_volume_m3"]
    rest = 900 * result["mesh_volume_m3"] + result["left_out_mass_kg"]
    assert rest == pytest.approx(whole, rel=0.04)
    assert Branch.open(place).has("point_masses.json")
    Reconstruct(cloud=folder / "cloud.ply", output=place).run()
    assert not Branch.open(place).has("point_masses.json")
    assert not load_model(Branch.open(place)).point_masses


@pytest.mark.slow
def test_left_out_twigs_weigh_in_a_simulation(generated, tmp_path):
    """Their weight hangs on the base, and on the gripper that holds the branch where it is."""
    folder, _, full = generated
    place = tmp_path / "w.branch"
    result = Reconstruct(cloud=folder / "cloud.ply", output=place, twig_radius=0.1,
                         upright=True).run()
    assert result["left_out_twigs"] == 2 and result["branch_count"] == full["branch_count"]
    model = load_model(Branch.open(place))
    weight = np.linalg.norm(solve_static(model).require().base_force)
    mass = 900 * result["mesh_volume_m3"] + result["left_out_mass_kg"]
    assert weight == pytest.approx(9.80665 * mass, rel=0.01)
    settings = SimulateSpec(kind="static", move=(0.0, 0.0, 1e-5), rest_shape=False)
    held = np.array(Simulated.of(settings, branch_folder=place).run()["grasp_force_n"])
    with Branch.open(place).stage("reconstruct") as stage:
        stage.path("point_masses.json").write_text("[]")
    bare = np.array(Simulated.of(settings, branch_folder=place, name="bare").run()["grasp_force_n"])
    assert 0.02 < np.linalg.norm(held - bare) / (9.80665 * result["left_out_mass_kg"]) < 2.0


def test_failed_run_leaves_the_folder_as_it_was(generated, tmp_path):
    """A refused cloud loses nothing of an earlier result."""
    folder, _, _ = generated
    before = (folder / "g.branch" / "branch.json").read_bytes()
    bad = tmp_path / "ball.xyz"
    normal = np.random.default_rng(0).normal(size=(2000, 3))
    np.savetxt(bad, normal / np.linalg.norm(normal, axis=1)[:, None])
    with pytest.raises(InputError, match="shape of a branch"):
        Reconstruct(cloud=bad, output=folder / "g.branch").run()
    assert (folder / "g.branch" / "branch.json").read_bytes() == before
    Branch.open(folder / "g.branch")


@pytest.mark.slow
def test_batch_goes_on_after_a_bad_scan(generated, tmp_path, capsys):
    """One bad scan never stops the others; the command ends with 3 and names it."""
    folder, _, _ = generated
    scans = tmp_path / "scans"
    scans.mkdir()
    (scans / "a_bad.xyz").write_text("1 2 three\n")
    (scans / "b_good.ply").write_bytes((folder / "cloud.ply").read_bytes())
    (scans / "._b_good.ply").write_bytes(b"resource fork")
    for _ in range(2):
        assert call(["reconstruct", str(scans), "-o", str(tmp_path / "out"), "--json"]) == 3
        result = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert result["done_count"] == 1 and list(result["failed"]) == ["a_bad.xyz"]
        assert "1 of 2 scans could not be reconstructed: a_bad.xyz" in result["error"]
    assert Branch.open(tmp_path / "out" / "b_good.branch").has("mesh.vtu")


@pytest.mark.parametrize("names", [
    ("tree 1.ply", "tree 1.xyz"), ("Tree.ply", "tree.ply"), ("a.b.ply", "a.b.PLY"),
    ("\u00e9.ply", "e\u0301.csv")])
def test_no_two_scans_of_a_folder_have_one_branch(tmp_path, names):
    """Refused before anything is computed, with both names."""
    for name in (*names, "other.ply"):
        (tmp_path / name).write_text("1 2 3\n")
    if len([*tmp_path.iterdir()]) < 3:
        pytest.skip("this file system does not distinguish the names")
    with pytest.raises(InputError) as refused:
        Reconstruct(cloud=tmp_path, output=tmp_path / "out").run()
    assert all(name in str(refused.value) for name in names)
    assert not (tmp_path / "out").exists()


def test_a_folder_of_scans_replaces_no_other_scans_branch(generated, tmp_path):
    """Another site's scan of one name, or another file of one stem: kept, with what to type."""
    kept = tmp_path / "out" / "cloud.branch"
    shutil.copytree(generated[0] / "g.branch", kept)
    before = (kept / "branch.json").read_bytes()
    for name, seen in (("cloud.csv", "not from cloud.csv"), ("cloud.ply", "not the same as")):
        scans = tmp_path / name.replace(".", "_")
        scans.mkdir()
        (scans / name).write_text("1 2 3\n")
        with pytest.raises(PartlyFailedError, match=rf"{seen}.*limber reconstruct .*{name}"):
            Reconstruct(cloud=scans, output=tmp_path / "out").run()
    assert (kept / "branch.json").read_bytes() == before


def test_points_by_class_are_no_scan_and_replace_none(tmp_path):
    """The second run of one command finds its own pictures of refused scans beside the scans."""
    Cloud(np.zeros((1, 3))).write_ply(tmp_path / "a_points.ply", CLASSES_COMMENT)
    with pytest.raises(InputError, match="no point clouds"):
        Reconstruct(cloud=tmp_path, output=tmp_path).run()
    Cloud(np.zeros((1, 3))).write_ply(tmp_path / "b 1.5_points.ply")
    assert _place_of_classes(tmp_path / "a.branch").name == "a_points.ply"
    assert _place_of_classes(tmp_path / "b 1.5").name == "b 1.5-2_points.ply"


def test_generate_is_reproducible(tmp_path):
    """The same seed gives the same bytes, another seed others."""
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        write_generated(generate_branch(seed, length=0.3), tmp_path / name)
    first, again, other = ((tmp_path / n / "cloud.ply").read_bytes() for n in "abc")
    assert first == again != other


def test_commands_exit_codes(tmp_path, capsys):
    """generate ends with 0 and JSON, a missing cloud with 2."""
    assert call(["generate", str(tmp_path / "g"), "--length", "0.3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["status"] == "done"
    assert call(["reconstruct", str(tmp_path / "none.ply"), "-o", str(tmp_path / "x")]) == 2


@pytest.mark.slow
def test_mesh_a_box_in_millimetres(tmp_path):
    """A closed STL becomes a branch of the right size, its long axis upright."""
    import trimesh

    box = trimesh.creation.box((30, 30, 100))
    box.export(tmp_path / "beam.stl")
    result = Mesh(surface=tmp_path / "beam.stl", output=tmp_path / "b.branch", unit="mm").run()
    assert result["mesh_volume_m3"] == pytest.approx(9e-5, rel=0.02)
    assert result["length_m"] == pytest.approx(0.1, rel=0.02)
    mesh = TetMesh.read(tmp_path / "b.branch" / "mesh.vtu")
    assert mesh.nodes[mesh.point_data["fixed"] == 1][:, 2].max() < 0.005


def test_points_to_leave_out_must_be_the_scans(tmp_path):
    """None of them in the scan, and all of them, are refused before any work; single precision is
    enough to recognise them."""
    points = np.random.default_rng(3).random((60, 3)) + [0.0, 0.0, 1000.0]
    scan, others = tmp_path / "scan.ply", tmp_path / "others.ply"
    Cloud(points).write_ply(scan)
    for given, told in ((points + 0.01, "None of the 60"), (points, "All 60"),
                        (points.astype(np.float32).astype(float), "All 60")):
        Cloud(given).write_ply(others)
        with pytest.raises(InputError, match=told):
            Reconstruct(cloud=scan, output=tmp_path / "b.branch", without=others).run()
    assert not (tmp_path / "b.branch").exists()


def test_points_to_leave_out_are_these_alone_in_map_coordinates(tmp_path):
    """There single precision has steps of half a metre, but the points of the file are exact."""
    points = np.random.default_rng(0).uniform(0, 1, (60, 3)) + [4e5, 5.6e6, 100.0]
    points[-1] = points[0]
    Cloud(points[:7]).write_ply(tmp_path / "stake.ply")
    left = _without(Cloud(points), tmp_path / "stake.ply").points
    np.testing.assert_array_equal(left, points[7:-1])


STEPS = ("laplacian", "contracting", "connecting", "fitting axes", "skeleton", "surface",
         "reconstructed")


@pytest.mark.slow
@pytest.mark.parametrize("step", STEPS)
def test_cancel_in_each_step_leaves_nothing(generated, tmp_path, step):
    """Stopped in any long step: Cancelled, and no half-made stage in the folder."""
    folder, _, _ = generated
    seen = []

    def sink(fraction, message, numbers):
        seen.append(message)
        if message.startswith(step):
            progress.cancel()

    progress = Progress(sink)
    target = tmp_path / "cancelled.branch"
    with pytest.raises(Cancelled):
        Reconstruct(cloud=folder / "cloud.ply", output=target).run(progress)
        progress(1.0, "the last report has nothing after it that could stop")
    assert any(message.startswith(step) for message in seen)
    if step != "reconstructed":
        assert not (target / "mesh.vtu").exists()
        assert not (target / "skeleton.swc").exists()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [
    0, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in (1, 2, 3))])
def test_a_leafy_plants_leaves_are_cut_off(tomato_draws, seed):
    """Of few points of a seedling whose leaves outweigh its stem, too: a few fat rods that explain
    most of them do not pass for wood."""
    made = reconstruct_cloud(Cloud(tomato_draws[seed]),
                             ReconstructSettings(unit="mm", leaves="cut", root="auto"))
    assert made.numbers["leaf_count"] == 2
    assert 0.65 < made.cloud.attributes["leaf"].mean() < 0.8
    assert made.numbers["radius_max_m"] < 0.002


def test_columns_of_any_name_come_through(tmp_path):
    """Titles that are no names of properties, or that mean something to Limber, lose nothing."""
    points = generate_branch(5, fork_count=0, length=0.4, point_spacing=0.004).cloud.points
    table = np.column_stack([np.arange(len(points)), points, np.tile([1, 2, 3], (len(points), 1))])
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", comments="", encoding="utf-8",
               header='"",x,y,z,Intensität [%],leaf,normal')
    Reconstruct(cloud=tmp_path / "a.csv", output=tmp_path / "a.branch").run()
    cloud = read_points(Branch.open(tmp_path / "a.branch").path("cloud.ply"))
    assert len(cloud) > 0.9 * len(points)
    assert cloud.attributes.keys() == {"unnamed", "intensitat", "leaf_2", "normal_2",
                                       "skeleton_node", "residual"}
