"""Awkward things that a user does with a branch: after each it is shown once, whole, and moving."""

import shutil

import numpy as np
import pytest
from tests.addon.conftest import make_beam_branch, part

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("worker_here")]


class Scene:
    """The beam in a scene, and what may be done with it."""

    def __init__(self, bpy, beam, tmp_path):
        self.bpy, self.beam, self.home, self.folder = bpy, beam, tmp_path, beam.folder
        self.show()

    def show(self):
        assert self.bpy.ops.limber.open_result(directory=str(self.folder)) == {"FINISHED"}
        return self.surface

    @property
    def surface(self):
        return part("branch.branches").find_surface(self.bpy.context.scene)

    @property
    def collection(self):
        return part("branch.branches").branch_of(self.surface)

    def thing(self, name):
        return self.bpy.data.objects[name]

    def activate(self, thing, mode="OBJECT"):
        part("branch.branches").activate(self.bpy.context.scene, thing)
        self.bpy.ops.object.mode_set(mode=mode)

    def save(self, name="mine.blend"):
        path = str(self.home / name)
        self.bpy.ops.wm.save_as_mainfile(filepath=path)
        return path

    def take(self, path, *, link):
        """Begin another file with the branch of a file."""
        self.bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        with self.bpy.data.libraries.load(path, link=link) as (theirs, mine):
            mine.collections = list(theirs.collections)
        self.bpy.context.scene.collection.children.link(mine.collections[0])
        return mine.collections[0]

    def rename(self, name):
        self.folder = self.folder.rename(self.folder.with_name(name))

    def check(self):
        """One surface, which is at each frame where the folder says."""
        surface = self.show()
        assert self.show() == surface and surface.library is None
        ids = [one["limber_id"] for one in self.bpy.context.scene.objects if "limber_id" in one]
        assert len(ids) == len(set(ids)) and {f"{self.collection['limber_id']}/{kind}" for kind in (
            "surface/", "path:plan/", "grasp/1", "goal/", "base/", "rest/")} <= set(ids)
        if surface.mode != "OBJECT":
            self.bpy.ops.object.mode_set(mode="OBJECT")
        layer = self.bpy.context.view_layer.layer_collection.children.get("beam")
        if layer is not None:
            # Blender computes no motion of what it hides.
            layer.exclude = layer.hide_viewport = layer.collection.hide_viewport = False
        for frame in (1, 6):
            self.bpy.context.scene.frame_set(frame)
            shape = surface.evaluated_get(self.bpy.context.evaluated_depsgraph_get()).data
            np.testing.assert_allclose(part("bridge.meshes").positions(shape),
                                       self.beam.frames[frame - 1], atol=1e-5)


def delete_the_collection(scene):
    for thing in list(scene.collection.objects):
        scene.bpy.context.scene.collection.objects.link(thing)
    scene.bpy.data.collections.remove(scene.collection)


def delete_all_and_purge(scene):
    scene.bpy.data.batch_remove(list(scene.collection.objects))
    scene.bpy.ops.outliner.orphans_purge(do_recursive=True)


def rename_the_folder(scene):
    scene.save()
    scene.rename("other name.branch")
    assert scene.bpy.ops.limber.relink() == {"FINISHED"}


def umlauts_in_a_long_name(scene):
    scene.rename(f"{'long ' * 30}Äste im Gebüsch ß 枝.branch")
    scene.save("Bäume.blend")


def a_folder_that_cannot_be_written(scene):
    scene.show()
    shutil.rmtree(scene.folder / ".viewport")
    (scene.folder / ".viewport").write_text("no folder can be made here")


def override_the_library(scene):
    branch = scene.take(scene.save(), link=True)
    scene.bpy.context.scene.collection.children.unlink(branch)
    branch.override_hierarchy_create(scene.bpy.context.scene, scene.bpy.context.view_layer)


def copy_the_collection(scene):
    copy = scene.collection.copy()
    for thing in list(copy.objects):
        copy.objects.unlink(thing)
        copy.objects.link(twin := thing.copy())
        twin.data = thing.data.copy()
    scene.bpy.context.scene.collection.children.link(copy)


def copy_save_and_reopen(scene):
    """Even under a name that sorts first, the copy is told from the original."""
    surface = scene.surface
    copy = surface.copy()
    copy.data = surface.data.copy()
    copy.name, surface.name = "a copy", "z original"
    scene.collection.objects.link(copy)
    scene.bpy.ops.wm.open_mainfile(filepath=scene.save())
    assert scene.show().name == "z original"


def join_into_an_own_mesh(scene):
    mine = scene.bpy.data.objects.new("mine", scene.bpy.data.meshes.new("mine"))
    scene.bpy.context.scene.collection.objects.link(mine)
    surface = scene.surface
    scene.activate(mine)
    surface.select_set(True)
    scene.bpy.ops.object.join()


def apply_the_motion(scene):
    scene.bpy.context.scene.frame_set(4)
    scene.activate(scene.surface)
    scene.bpy.ops.object.modifier_apply(modifier=scene.surface.modifiers[0].name)


def apply_a_mirrored_scale(scene):
    scene.activate(scene.surface)
    scene.surface.scale = (-2.0, 1.0, 0.5)
    scene.bpy.ops.object.transform_apply()


def convert_to_a_curve(scene):
    scene.activate(scene.thing("gentle path"))
    scene.bpy.ops.object.convert(target="CURVE")


def subdivide_the_mesh(scene):
    scene.activate(scene.surface, "EDIT")
    scene.bpy.ops.mesh.select_all(action="SELECT")
    scene.bpy.ops.mesh.subdivide()
    scene.bpy.ops.object.mode_set(mode="OBJECT")


def hide_the_collection(scene):
    scene.bpy.context.view_layer.layer_collection.children["beam"].hide_viewport = True
    scene.collection.hide_viewport = True


def exclude_the_layer(scene):
    scene.bpy.context.view_layer.layer_collection.children["beam"].exclude = True


def other_units_and_frame(scene):
    settings = scene.bpy.context.scene.unit_settings
    settings.system, settings.scale_length = "IMPERIAL", 0.01
    scene.bpy.context.scene.frame_set(-3, subframe=0.5)


def a_parent_that_is_deleted(scene):
    box = scene.bpy.data.objects.new("box", None)
    scene.bpy.context.scene.collection.objects.link(box)
    scene.surface.parent = box
    scene.bpy.data.objects.remove(box)


def undo_and_redo_a_result(scene):
    scene.bpy.ops.ed.undo_push(message="before")
    scene.show()
    scene.bpy.ops.ed.undo_push(message="after")
    for turn in (scene.bpy.ops.ed.undo, scene.bpy.ops.ed.redo, scene.bpy.ops.ed.undo):
        turn()
        scene.show()


def another_branch_in_the_same_folder(scene):
    shutil.rmtree(scene.folder)
    make_beam_branch(scene.folder)


def a_second_scene_without_the_first(scene):
    first = scene.bpy.context.scene
    other = scene.bpy.data.scenes.new("other")
    other.collection.children.link(scene.collection)
    scene.bpy.context.window.scene = other
    scene.bpy.data.scenes.remove(first)


ONE_LINE = {
    "delete a mark": lambda one: one.bpy.data.objects.remove(one.thing("Control point 2")),
    "delete the surface": lambda one: one.bpy.data.objects.remove(one.surface),
    "delete an attribute": lambda one: one.surface.data.attributes.remove(
        one.surface.data.attributes["young_color"]),
    "append": lambda one: one.take(one.save(), link=False),
    "link": lambda one: one.take(one.save(), link=True),
    "copy the scene": lambda one: one.bpy.ops.scene.new(type="FULL_COPY"),
    "leave Edit Mode on": lambda one: one.activate(one.surface, "EDIT"),
    "leave Sculpt Mode on": lambda one: one.activate(one.surface, "SCULPT"),
    "leave Weight Paint on": lambda one: one.activate(one.surface, "WEIGHT_PAINT"),
    "share the mesh": lambda one: setattr(one.thing("Rest shape"), "data", one.surface.data)}
AWKWARD = ONE_LINE | {name.replace("_", " "): each for name, each in list(globals().items())
                      if getattr(each, "__module__", "") == __name__ and name.islower()}


@pytest.mark.parametrize("act", AWKWARD.values(), ids=AWKWARD)
def test_it_is_shown_once_and_whole(bpy, worker_here, beam, tmp_path, act):
    assert len(AWKWARD) >= 25
    scene = Scene(bpy, beam, tmp_path)
    act(scene)
    scene.check()
