"""Which branch is meant: panels, steps and sessions all ask once, and get the one in sight."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from tests.addon.conftest import part
from tests.addon.test_panels import Layout

from limber.cli.main import call

pytestmark = pytest.mark.usefixtures("worker_here")

BLEND_FILES = Path(__file__).parents[2] / "blend_files"


def _targets(folder):
    path = folder / "targets.json"
    return [each["name"] for each in json.loads(path.read_text())["targets"]] if (
        path.is_file()) else []


@pytest.fixture()
def two(bpy, registered, bare_beam):
    """Two opened branches, the second one last: their folders and their collections."""
    other = bare_beam.folder.with_name("b.branch")
    shutil.copytree(bare_beam.folder, other)
    folders = (bare_beam.folder, other)
    for folder in folders:
        assert bpy.ops.limber.open_result(directory=str(folder)) == {"FINISHED"}
    return folders, part("branch.branches").branches(bpy.context.scene)


def _mark(bpy, parent):
    """Return an empty of the user's that hangs on an object, outside the branch's collection."""
    empty = bpy.data.objects.new("mark", None)
    bpy.context.scene.collection.objects.link(empty)
    empty.parent = parent
    return empty


@pytest.mark.slow
@pytest.mark.parametrize("chosen", ["surface", "another part", "what hangs on it"])
def test_a_step_works_on_the_branch_of_the_active_object(bpy, two, chosen):
    """a opened, then b, then a made active: the target goes into a, and all else says a too."""
    folders, (first, _) = two
    scene, branches = bpy.context.scene, part("branch.branches")
    surface = branches.surface_of(first)
    active = {"surface": surface, "what hangs on it": _mark(bpy, surface),
              "another part": next(thing for thing in first.objects if thing != surface)}[chosen]
    bpy.context.view_layer.objects.active = active
    assert branches.find_surface(scene) == surface
    assert Path(scene.limber.branch_folder) == folders[0], "as the panel shows it"
    assert bpy.ops.limber.target(name="flower", at=(0.0, 0.0, 0.3)) == {"FINISHED"}
    assert [_targets(folder) for folder in folders] == [["flower"], []]
    assert part("panels.steps").state_of(scene, "target")[0] is part("jobs.steps").StepState.DONE


@pytest.mark.slow
def test_the_branch_used_last_stays(bpy, two):
    """A lamp is chosen after a: still a. The one opened last is the current one before."""
    folders, (first, second) = two
    scene, branches = bpy.context.scene, part("branch.branches")
    assert branches.current_folder(scene) == folders[1]
    assert bpy.context.view_layer.objects.active == branches.surface_of(second)
    layer = bpy.context.view_layer
    layer.objects.active = branches.surface_of(first)
    branches.surface_of(first).select_set(True)
    layer.update()
    lamp = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "SUN"))
    scene.collection.objects.link(lamp)
    layer.objects.active = lamp
    layer.update()
    assert branches.current_folder(scene) == folders[0]
    assert branches.find_surface(scene) == branches.surface_of(first)


@pytest.mark.slow
def test_a_folder_that_was_chosen_is_the_current_one(bpy, two, tmp_path):
    """Entered in the panel or given by a script: its branch becomes active; one that is not shown
    leaves none active."""
    folders, (first, _) = two
    scene, branches, layer = bpy.context.scene, part("branch.branches"), bpy.context.view_layer
    scene.limber.branch_folder = f"{folders[0]}/"
    assert layer.objects.active == branches.surface_of(first)
    assert bpy.ops.limber.target(branch_folder=str(folders[1]), name="fruit",
                                 at=(0.0, 0.0, 0.3)) == {"FINISHED"}
    assert [_targets(folder) for folder in folders] == [[], ["fruit"]]
    assert branches.current_folder(scene) == folders[1]
    third = tmp_path / "third.branch"
    shutil.copytree(folders[0], third)
    scene.limber.branch_folder = str(third)
    assert branches.find_surface(scene) is None and layer.objects.active is None
    drawn = Layout()
    bpy.types.LIMBER_PT_result.draw(SimpleNamespace(layout=drawn), bpy.context)
    assert "Not shown: press Open Result" in drawn.names("label")
    assert bpy.ops.limber.target(name="bud", at=(0.0, 0.0, 0.3)) == {"FINISHED"}
    assert [_targets(folder) for folder in (*folders, third)] == [[], ["fruit"], ["bud"]]


@pytest.mark.slow
def test_a_button_means_the_branch_that_it_was_drawn_for(bpy, two):
    """Drawn for a; b becomes the current one; pressed: into a. The list says which is current."""
    folders, shown = two
    scene, branches = bpy.context.scene, part("branch.branches")
    for branch, uuid in zip(shown, ("uuid-a", "uuid-b"), strict=True):
        branch[branches.UUID_KEY] = uuid
        path = Path(branch[branches.FOLDER_KEY]) / "branch.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"uuid": uuid}))
    scene.limber.branch = shown[0].name
    assert branches.current_uuid(scene) == "uuid-a"
    assert bpy.context.view_layer.objects.active == branches.surface_of(shown[0])
    scene.limber.branch = shown[1].name
    assert scene.limber.branch == shown[1].name and branches.current_uuid(scene) == "uuid-b"
    bpy.ops.limber.target(branch_uuid="uuid-a", name="flower", at=(0.0, 0.0, 0.3))
    assert [_targets(folder) for folder in folders] == [["flower"], []]
    with pytest.raises(RuntimeError, match="no longer in the scene"):
        bpy.ops.limber.target(branch_uuid="uuid-c", name="flower", at=(0.0, 0.0, 0.3))


@pytest.mark.slow
def test_a_folder_that_has_another_branch_by_now_is_shown_before_it_is_written(bpy, two):
    """Replaced on the disk: steps refuse, Open Result shows what is there, and then they work."""
    folders, (_, shown) = two
    shown[part("branch.branches").UUID_KEY] = "another"
    with pytest.raises(RuntimeError, match=r"another branch now.*Open Result"):
        bpy.ops.limber.target(name="flower", at=(0.0, 0.0, 0.3))
    assert bpy.ops.limber.open_result() == {"FINISHED"}
    assert bpy.ops.limber.target(name="flower", at=(0.0, 0.0, 0.3)) == {"FINISHED"}
    assert [_targets(folder) for folder in folders] == [[], ["flower"]]


@pytest.mark.slow
def test_a_refused_folder_leaves_the_current_one(bpy, two, tmp_path):
    """What cannot be opened is not where the next step writes."""
    folders, _ = two
    with pytest.raises(RuntimeError, match=r"branch\.json"):
        bpy.ops.limber.open_result(directory=str(tmp_path))
    assert part("branch.branches").current_folder(bpy.context.scene) == folders[1]


@pytest.mark.slow
def test_a_scan_stands_for_its_own_folder(bpy, two, tmp_path):
    """Imported beside a branch, then chosen again: a branch is made in the scan's folder."""
    folders, (first, _) = two
    scene, branches = bpy.context.scene, part("branch.branches")
    (tmp_path / "twig.xyz").write_text("0 0 0\n0 0 0.1\n0 0 0.2\n")
    bpy.ops.limber.import_cloud(filepath=str(tmp_path / "twig.xyz"))
    assert branches.current_folder(scene) == tmp_path / "twig.branch"
    bpy.context.view_layer.objects.active = branches.surface_of(first)
    assert branches.current_folder(scene) == folders[0]
    bpy.context.view_layer.objects.active = scene.objects["twig scan"]
    assert branches.current_folder(scene) == tmp_path / "twig.branch"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "twig.blend"))
    assert scene.limber.branch_folder == "//twig.branch"


@pytest.mark.parametrize("name", ["bending_branch", "young", "mature", "artificial"])
def test_a_shipped_scene_has_its_folder(bpy, registered, name):
    """The one beside it, with nothing chosen: steps work there."""
    bpy.ops.wm.open_mainfile(filepath=str(BLEND_FILES / f"{name}.blend"))
    scene = bpy.context.scene
    assert scene.limber.branch_folder == f"//{name}"
    assert part("branch.branches").current_folder(scene).resolve() == BLEND_FILES / name
    assert part("panels.steps").state_of(scene, "estimate")[1] is not None


@pytest.mark.slow
def test_a_scene_of_the_worker_has_its_folder(bpy, registered, bare_beam, capsys):
    """`limber scene`: relative to the file; moved without its folder, the steps say what to do."""
    there = bare_beam.folder.parent / "scenes" / "beam.blend"
    assert call(["scene", str(bare_beam.folder), "-o", str(there)]) == 0, capsys.readouterr()
    bpy.ops.wm.open_mainfile(filepath=str(there))
    scene = bpy.context.scene
    assert scene.limber.branch_folder == f"//../{bare_beam.folder.name}"
    assert bpy.ops.limber.target(name="flower", at=(0.0, 0.0, 0.3)) == {"FINISHED"}
    assert _targets(bare_beam.folder) == ["flower"]
    bare_beam.folder.rename(bare_beam.folder.with_name("away.branch"))
    for step in ("target", "estimate", "report"):
        with pytest.raises(RuntimeError, match=r"Find the Folder Again"):
            getattr(bpy.ops.limber, step)()


def test_a_scene_without_a_folder_says_so(bpy, registered):
    """Nothing was opened: the step says that, and how a folder is chosen."""
    with pytest.raises(RuntimeError, match=r"This scene has no branch folder.*Open Result"):
        bpy.ops.limber.target(name="flower", at=(0.0, 0.0, 0.3))
