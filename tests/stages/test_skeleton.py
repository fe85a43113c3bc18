"""`limber skeleton`, and the skeleton that reconstruct keeps in the scan's own coordinates."""

import json
import shutil
import subprocess
import sys
from dataclasses import asdict, replace

import numpy as np
import pytest

import limber
from limber import store
from limber.cli.main import call
from limber.core.errors import InputError, MeshingError
from limber.core.files.atomic import file_digest
from limber.core.json_values import plain
from limber.core.progress import Progress
from limber.geometry import reconstruction
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.leaves import Leaf
from limber.geometry.generated import generate_branch
from limber.geometry.io.skeletons import read_skeleton, read_swc
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.search_result import FoundSkeleton, result_of_skeleton
from limber.geometry.skeleton.skeleton import Skeleton
from limber.results.scene.animation import scene_data
from limber.results.scene.still_objects import EDITED
from limber.stages.shape.edit_skeleton import ReviewSkeleton
from limber.stages.shape.reconstruct import Reconstruct, load_search
from limber.store import Branch

# Map coordinates in millimetres, its z along the file's y.
OFFSET = np.array([4.5e8, 1.2e6, -3.0e6])
SETTINGS = ReconstructSettings(unit="mm", up=(0.0, 1.0, 0.0), upright=True)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A scan in millimetres far from the origin, lying on its side, and its branch folder."""
    folder = tmp_path_factory.mktemp("scan")
    points = 1e3 * generate_branch(5, fork_count=1, length=0.4, point_spacing=0.0025).cloud.points
    Cloud(points[:, [1, 2, 0]] + OFFSET).write_ply(folder / "cloud.ply")
    result = Reconstruct.of(SETTINGS, cloud=folder / "cloud.ply", output=folder / "a.branch").run()
    return folder, result


def test_a_kept_skeleton_given_back_is_used_as_it_is(made, tmp_path) -> None:
    """In the file's coordinates; states, deviations and probabilities come back too."""
    folder, result = made
    kept = read_swc(folder / "a.branch" / "scan_skeleton.swc", scale=1.0)
    assert np.abs(kept.nodes - OFFSET).max() < 1000 and kept.radius.max() > 3
    again = Reconstruct.of(SETTINGS, cloud=folder / "cloud.ply", output=tmp_path / "b.branch",
                           skeleton=folder / "a.branch" / "scan_skeleton.csv").run()
    one, other = (read_skeleton(place / "skeleton.csv")
                  for place in (folder / "a.branch", tmp_path / "b.branch"))
    np.testing.assert_allclose(other.nodes, one.nodes, atol=2e-8)
    np.testing.assert_allclose(other.radius, one.radius, rtol=1e-6)
    np.testing.assert_allclose(other.radius_sigma, one.radius_sigma, rtol=1e-2)
    assert (other.radius_state == one.radius_state).all()
    assert again["tet_count"] == result["tet_count"]
    assert again["mesh_volume_m3"] == pytest.approx(result["mesh_volume_m3"], rel=1e-4)


@pytest.mark.slow
def test_an_alternative_is_applied_by_its_number(made, tmp_path) -> None:
    """The twig of a scan far away, in millimetres, is gone; a number that there is not is refused.
    """
    folder, result = made
    target = shutil.copytree(folder / "a.branch", tmp_path / "n.branch")
    listed = ReviewSkeleton(branch_folder=target).run()["alternatives"]
    assert listed == result["alternatives"] and listed[0]["edits"] == []
    assert [edit["do"] for edit in listed[1]["edits"]] == ["delete"]
    with pytest.raises(InputError, match=f"has {len(listed) - 1} alternatives"):
        ReviewSkeleton(branch_folder=target, alternative=9).run()
    other = limber.open(target).alternatives[1]
    assert (other.length, other.edits[0].do) == (listed[1]["length_m"], "delete")
    chosen = ReviewSkeleton(branch_folder=target, alternative=2).run()
    assert chosen["branch_count"] == result["branch_count"] - 1
    assert chosen["length_m"] == pytest.approx(listed[1]["length_m"], rel=1e-6)
    low, high = result["length_interval_m"]
    assert low <= result["length_m"] <= high


@pytest.mark.slow
def test_edits_outlive_a_new_reconstruct(made, tmp_path) -> None:
    """The mesh follows an edit; the folder keeps it; a misfit is told; an empty list undoes it."""
    folder, result = made
    scan, target = folder / "cloud.ply", tmp_path / "e.branch"
    Reconstruct.of(SETTINGS, cloud=scan, output=target).run()
    alignment = Branch.open(target).manifest.alignment
    before = read_skeleton(target / "skeleton.csv")
    tip = alignment.undo(before.nodes[before.branch == 1][-3:-2])[0].tolist()
    edits = tmp_path / "edits.json"
    edits.write_text(json.dumps([{"do": "delete", "at": tip}]))
    told = ReviewSkeleton(branch_folder=target, edits=edits, output=tmp_path / "out.swc").run()
    assert told["length_m"] < result["length_m"] and told["mesh"] == "current"
    assert told["edit_effects"][0]["length_change_m"] == pytest.approx(
        told["length_m"] - result["length_m"])
    assert Branch.open(target, verify=True).manifest.stages["reconstruct"].result[
        "mesh_volume_m3"] < result["mesh_volume_m3"]
    written = read_swc(tmp_path / "out.swc")
    assert written.length == pytest.approx(told["length_m"], rel=1e-4)
    # The same reconstruct is current with its edits; one with other settings applies them anew.
    assert Reconstruct.of(SETTINGS, cloud=scan,
                          output=target).run()["length_m"] == pytest.approx(told["length_m"])
    other = Reconstruct.of(SETTINGS.model_copy(update={"young": 2e8}), cloud=scan,
                           output=target).run()
    assert other["length_m"] == pytest.approx(told["length_m"], rel=1e-6)
    far = (OFFSET + 2000).tolist()
    edits.write_text(json.dumps([{"do": "delete", "at": far}]))
    with pytest.raises(InputError, match=r"Edit 1 .*not belong to any branch"):
        ReviewSkeleton(branch_folder=target, edits=edits).run()
    assert len(ReviewSkeleton(branch_folder=target).run()["edits"]) == 1
    warned: list[str] = []
    undone = Reconstruct.of(SETTINGS, cloud=scan, output=target,
                            edits=edits).run(Progress(on_warning=warned.append))
    assert undone["length_m"] == pytest.approx(result["length_m"])
    assert any("Edit 1 (delete)" in text and "skipped" in text for text in warned)
    assert ReviewSkeleton(branch_folder=target).run()["edit_effects"] == []
    edits.write_text("[]")
    assert ReviewSkeleton(branch_folder=target, edits=edits).run()["edits"] == []
    assert not (target / "edits.json").exists()


def test_edits_in_the_branchs_frame_come_after_those_before(made, tmp_path) -> None:
    """Metres along the branch's axes; the scene marks what is not as it was found, no more."""
    folder, _ = made
    target, edits = tmp_path / "g.branch", tmp_path / "edits.json"
    shutil.copytree(folder / "a.branch", target)
    before = read_skeleton(target / "skeleton.csv")
    node = np.flatnonzero(before.branch == 1)[3]
    onto = before.nodes[node] + [0.0, 0.002, 0.001]
    for edit in ({"do": "move", "at": before.nodes[node].tolist(), "to": onto.tolist()},
                 {"do": "radius", "at": onto.tolist(), "radius": 1.1 * before.radius[node]}):
        edits.write_text(json.dumps([edit]))
        told = ReviewSkeleton(branch_folder=target, edits=edits, frame="branch", append=True).run()
    assert [edit["do"] for edit in told["edits"]] == ["move", "radius"]
    after = read_skeleton(target / "skeleton.csv")
    moved = np.linalg.norm(after.nodes - onto, axis=1).argmin()
    np.testing.assert_allclose(after.nodes[moved], onto, atol=1e-7)
    assert after.radius[moved] == pytest.approx(1.1 * before.radius[node], rel=1e-6)
    arrays = scene_data(Branch.open(target)).arrays
    marked = np.flatnonzero(arrays["skeleton_flags"] & EDITED)
    # The moved node, and the one that hangs on it.
    assert set(marked) == {moved, *np.flatnonzero(arrays["skeleton_parent"] == moved)}
    assert not (scene_data(Branch.open(folder / "a.branch")).arrays["skeleton_flags"] & EDITED
                ).any()


_DYING = """
import os, sys
from pathlib import Path
from limber.geometry import reconstruction
from limber.geometry.settings import ReconstructSettings
from limber.stages.shape.reconstruct import Reconstruct
reconstruction.mesh_skeleton = lambda *given: os._exit(9)
scan, target = map(Path, sys.argv[1:3])
settings = ReconstructSettings.model_validate_json(sys.argv[3])
Reconstruct.of(settings, cloud=scan, output=target).run()
"""


@pytest.mark.slow
def test_one_killed_after_its_skeleton_goes_on_from_there(made, tmp_path, monkeypatch) -> None:
    """kill -9 between skeleton and mesh: nothing is sought again, and every byte is the same."""
    folder, result = made
    scan, target = folder / "cloud.ply", tmp_path / "k.branch"
    died = subprocess.run([sys.executable, "-c", _DYING, str(scan), str(target),
                           SETTINGS.model_dump_json()], check=False)
    assert died.returncode == 9
    before = Branch.open(target, verify=True).manifest
    assert set(before.stages) == {"skeleton"}
    # Other settings, other programs and --force know nothing of it.
    branch, digests = Branch.open(target), before.stages["skeleton"].reads
    assert load_search(branch, SETTINGS, digests) is not None
    assert load_search(branch, SETTINGS.model_copy(update={"gap_factor": 4.0}), digests) is None
    with monkeypatch.context() as other:
        other.setattr(store, "program_versions", lambda: before.stages["skeleton"].programs | {
            "numpy": "0"})
        assert load_search(branch, SETTINGS, digests) is None
    # A damaged one counts as none; where its checksum is right all the same, that is said.
    search, told = target / "scan_skeleton.npz", []
    whole = search.read_bytes()
    search.write_bytes(whole[:-200] + bytes(200))
    assert load_search(branch, SETTINGS, digests) is None
    entry = branch.manifest.files[search.name]
    entry.sha256, entry.bytes = file_digest(search), search.stat().st_size
    assert load_search(branch, SETTINGS, digests, Progress(on_warning=told.append)) is None
    assert len(told) == 1 and "searched for again" in told[0]
    search.write_bytes(whole)

    def search_again(*_given, **_named):
        raise AssertionError("the skeleton is sought again")
    with monkeypatch.context() as other:
        other.setattr(reconstruction, "skeletonise", search_again)
        with pytest.raises(AssertionError):
            Reconstruct.of(SETTINGS, cloud=scan, output=target, force=True).run()
        again = Reconstruct.of(SETTINGS, cloud=scan, output=target).run()
    after, undisturbed = (Branch.open(place, verify=True).manifest
                          for place in (target, folder / "a.branch"))
    assert after.stages["skeleton"] == before.stages["skeleton"]
    assert after.files == undisturbed.files and not (target / "scan_skeleton.npz").exists()
    assert {key: again[key] for key in result.keys() - {"peak_memory_mb"}} == {
        key: result[key] for key in result.keys() - {"peak_memory_mb"}}


def test_a_search_comes_back_to_its_last_bit(tmp_path) -> None:
    """All that it found, with gaps, pieces and places; a mangled file is refused."""
    rng = np.random.default_rng(3)
    skeleton = Skeleton.from_edges(rng.normal(size=(6, 3)), np.arange(6) - 1, rng.random(6) + 0.1)
    place, points = rng.normal(size=3), rng.normal(size=(40, 3))
    found = replace(
        result_of_skeleton(skeleton, points), noise=0.1 / 3, loops=[1 / 7], pruned=4, leafy=True,
        second_base=place, root_ends=[
            {"at": place, "probability": 2 / 3}], bridges=[
            {"from": place, "to": -place, "length": 1 / 3, "price": 2.0},
            {"from": place, "to": -place, "length": 1 / 3, "price": 2.0, "thickness": 1 / 7,
             "probability": 1 / 3, "rival_from": place, "rival_to": None, "rival_price": None}],
        split_off=[{"points": 7, "distance": 0.7 / 3, "at": place}],
        unlikely=[{"length": 1e-9 / 3, "at": place, "probability": 0.3}])
    path = tmp_path / "found.npz"
    leaves = [Leaf(np.array([40, 3, 7]), 1 / 3), Leaf(np.array([41, 0]), 1 / 7)]
    FoundSkeleton(found, leaves).write(path)
    read = FoundSkeleton.read(path)
    assert [(leaf.points.tolist(), leaf.area) for leaf in read.leaves] == [
        (leaf.points.tolist(), leaf.area) for leaf in leaves]
    assert plain(asdict(read.result)) == plain(asdict(found))
    arrays = dict(np.load(path))
    for name, value in (("parent", np.arange(6)), ("node_of_point", np.full(40, 6)),
                        ("told", np.array("{}")), ("nodes", np.full((6, 3), np.nan)),
                        ("nodes", np.zeros((6, 3))), ("radius", np.zeros(6)),
                        ("radius", np.full(6, 1e-300)), ("radius_sigma", np.full(6, 1e200)),
                        ("nodes", arrays["nodes"] > 0), ("probability", np.full(6, 1.5)),
                        ("branch", np.arange(6) + 1), ("branch", np.array([0, 0, 0, 2, 2, 2])),
                        ("branch", np.array([0, 0, 1, 1, 0, 0])), ("order", np.zeros(6)),
                        ("branch", np.zeros(6, bool)), ("radius_state", np.full(6, 9)),
                        ("told", np.array(str(arrays["told"]).replace("0.3333", "1e300"))),
                        ("leaf_points", np.array([40, 3, 7])),
                        ("leaf_points", np.array([40, 3, 7, 45, 0]))):
        np.savez(path, **arrays | {name: value})
        with pytest.raises(InputError, match=r"found\.npz"):
            FoundSkeleton.read(path)


@pytest.mark.slow
def test_a_failed_mesh_leaves_the_skeleton(made, tmp_path, monkeypatch, capsys) -> None:
    """The kept skeleton is there, listed, and said to be without a mesh; then it is mended."""
    folder, result = made
    target = tmp_path / "f.branch"

    def fail(*_given, **_named):
        raise MeshingError("No mesh.")
    monkeypatch.setattr(reconstruction, "mesh_skeleton", fail)
    warned: list[str] = []
    with pytest.raises(MeshingError, match=r"^No mesh\.$"):
        Reconstruct.of(SETTINGS, cloud=folder / "cloud.ply",
                       output=target).run(Progress(on_warning=warned.append))
    assert any("scan_skeleton.swc" in text for text in warned)
    assert call(["skeleton", str(target), "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["mesh"] == "missing" and told["unit"] == "mm"
    assert told["length_m"] == pytest.approx(result["length_m"], rel=1e-6)
    edits = tmp_path / "edits.json"
    edits.write_text("[]")
    with pytest.raises(InputError, match="scan is needed again"):
        ReviewSkeleton(branch_folder=target, edits=edits).run()
    monkeypatch.undo()
    again = Reconstruct.of(SETTINGS, cloud=folder / "cloud.ply", output=target,
                           skeleton=target / "scan_skeleton.csv").run()
    assert again["tet_count"] == result["tet_count"]
    assert ReviewSkeleton(branch_folder=target).run()["mesh"] == "current"
