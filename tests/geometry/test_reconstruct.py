"""The commands reconstruct, generate and mesh, on real scans and on what they must refuse."""

import json
import time

import numpy as np
import pytest
from scipy.spatial import cKDTree

from limber.cli import call
from limber.errors import InputError
from limber.geometry.batch import reconstruct_folder
from limber.geometry.cloud_files import read_points
from limber.geometry.generated import generate_branch, write_generated
from limber.geometry.mesh_surface import MeshSurfaceSettings, mesh_surface
from limber.geometry.reconstruct import ReconstructSettings, reconstruct
from limber.geometry.skeleton import Skeleton
from limber.geometry.tet_mesh import TetMesh
from limber.store import Branch

KEYS = ("point_count", "node_count", "branch_count", "length_m", "radius_min_m", "radius_max_m",
        "surface_volume_m3", "mesh_volume_m3", "tet_count", "watertight", "clamped_radius_count",
        "peak_memory_mb")


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    """A generated branch on disk, reconstructed."""
    folder = tmp_path_factory.mktemp("generated")
    branch = generate_branch(5, fork_count=2, length=0.6, point_spacing=0.0025)
    write_generated(branch, folder)
    result = reconstruct(folder / "cloud.ply", folder / "g.branch")
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


def test_truth_is_carried_in_the_branch_frame(generated):
    """The true skeleton lies on the reconstructed one after alignment, and Young's modulus too."""
    folder, branch, _ = generated
    opened = Branch.open(folder / "g.branch")
    truth = Skeleton.read_swc(opened.path("truth/skeleton.swc"))
    found = Skeleton.read_swc(opened.path("skeleton.swc"))
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


def test_second_run_is_skipped(generated):
    """Nothing has changed: the stored result comes at once."""
    folder, _, result = generated
    started = time.perf_counter()
    again = reconstruct(folder / "cloud.ply", folder / "g.branch")
    assert time.perf_counter() - started < 2 and again == result


def test_gravity_turns_with_the_branch(generated):
    """Turned upright, gravity keeps its size and its angle to the branch."""
    _, _, result = generated
    assert np.linalg.norm(result["gravity_m_s2"]) == pytest.approx(9.80665)


def test_coffeetree(coffeetree, tmp_path):
    """The real branch: forks found, valid surface, a mesh of the surface's volume."""
    result = reconstruct(coffeetree, tmp_path / "c.branch")
    assert 7 <= result["branch_count"] <= 14
    assert 4.5 < result["length_m"] < 5.6
    assert result["radius_max_m"] < 0.03
    assert result["watertight"] and result["surface_check"]["self_intersection_count"] == 0
    assert result["mesh_volume_m3"] == pytest.approx(result["surface_volume_m3"], rel=0.03)
    assert 1000 < result["tet_count"] < 4000


def test_own_skeleton_skips_ours(generated, tmp_path):
    """A given skeleton is used as it is."""
    folder, branch, _ = generated
    result = reconstruct(folder / "cloud.ply", tmp_path / "o.branch",
                         skeleton_path=folder / "truth_skeleton.swc")
    assert result["contraction_status"] == "skeleton given"
    assert result["length_m"] == pytest.approx(branch.skeleton.length, rel=1e-4)


def test_left_out_twigs_become_masses(generated, tmp_path):
    """Twigs over the order leave the mesh, and their mass is written."""
    folder, _, full = generated
    result = reconstruct(folder / "cloud.ply", tmp_path / "t.branch",
                         ReconstructSettings(twig_order=0))
    masses = json.loads((tmp_path / "t.branch" / "point_masses.json").read_text())
    assert len(masses) == result["left_out_twigs"] == 2
    whole = 900 * full["mesh_volume_m3"]
    rest = 900 * result["mesh_volume_m3"] + result["left_out_mass_kg"]
    assert rest == pytest.approx(whole, rel=0.04)


def test_failed_run_leaves_the_folder_as_it_was(generated, tmp_path):
    """A refused cloud loses nothing of an earlier result."""
    folder, _, _ = generated
    before = (folder / "g.branch" / "branch.json").read_bytes()
    bad = tmp_path / "ball.xyz"
    normal = np.random.default_rng(0).normal(size=(2000, 3))
    np.savetxt(bad, normal / np.linalg.norm(normal, axis=1)[:, None])
    with pytest.raises(InputError, match="branch-like"):
        reconstruct(bad, folder / "g.branch")
    assert (folder / "g.branch" / "branch.json").read_bytes() == before
    Branch.open(folder / "g.branch")


def test_batch_goes_on_after_a_bad_scan(generated, tmp_path):
    """One bad scan never stops the others."""
    folder, _, _ = generated
    scans = tmp_path / "scans"
    scans.mkdir()
    (scans / "a_bad.xyz").write_text("1 2 three\n")
    (scans / "b_good.ply").write_bytes((folder / "cloud.ply").read_bytes())
    told = []
    result = reconstruct_folder(scans, tmp_path / "out", warn=told.append)
    assert result["done_count"] == 1 and list(result["failed"]) == ["a_bad.xyz"]
    assert Branch.open(tmp_path / "out" / "b_good.branch").has("mesh.vtu")


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
    result = mesh_surface(tmp_path / "beam.stl", tmp_path / "b.branch",
                          MeshSurfaceSettings(unit="mm", elements_across=2))
    assert result["mesh_volume_m3"] == pytest.approx(9e-5, rel=0.02)
    assert result["length_m"] == pytest.approx(0.1, rel=0.02)
    mesh = TetMesh.read(tmp_path / "b.branch" / "mesh.vtu")
    assert mesh.nodes[mesh.point_data["fixed"] == 1][:, 2].max() < 0.005
