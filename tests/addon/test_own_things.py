"""What is the user's stays after every result: one table of things, and what else may happen."""

import json
import shutil

import numpy as np
import pytest
from tests.addon.conftest import make_beam_branch, part, write_plan

from limber.cli.main import call
from limber.geometry.skeleton.skeleton import Skeleton
from limber.results.scene.animation import scene_data
from limber.store import Branch

pytestmark = pytest.mark.usefixtures("worker_here")


def result_of(folder, *, stage, mesh=None, write_pc2=None, frames=None):
    """Write what a stage leaves: a new mesh, a simulated motion."""
    with Branch.open(folder).stage(stage, reads=[] if mesh is not None else ["mesh.vtu"]) as made:
        if mesh is not None:
            mesh.write(made.path("mesh.vtu"))
        if frames is not None:
            write_pc2(made.path("frames/swing.pc2"), frames)
            times = [number / 24 for number in range(len(frames))]
            made.path("frames/swing.json").write_text(json.dumps({"rate": 24.0, "times_s": times}))
            np.savez(made.path("frames/swing.npz"), strain_energy_density_j_m3=frames[..., 2])


@pytest.fixture()
def shown(bpy, beam):
    """A function that shows the folder's present result; shown once."""
    def show(folder=beam.folder):
        assert bpy.ops.limber.open_result(directory=str(folder)) == {"FINISHED"}
        return part("branch.branches").find_surface(bpy.context.scene)
    show()
    return show


def things(bpy):
    return bpy.data.objects


def _own_object(bpy):
    cube = bpy.data.objects.new("mine", bpy.data.meshes.new("mine"))
    bpy.data.collections["beam"].objects.link(cube)
    cube.location = (0.1, 0.2, 0.3)
    cube["number"] = 7
    return lambda: (things(bpy)["mine"].location[:], things(bpy)["mine"]["number"],
                    things(bpy)["mine"].users_collection[0].name)


def _own_object_with_keys(bpy):
    cube = bpy.data.objects.new("keyed", None)
    bpy.data.collections["beam"].objects.link(cube)
    for frame, place in ((1, 0.0), (20, 1.0)):
        cube.location.x = place
        cube.keyframe_insert("location", frame=frame)
    # Moved without a key: evaluating the frame again would lose it.
    cube.location.x = 0.7
    compat = part("compat")
    return lambda: (things(bpy)["keyed"].location.x,
                    [curve.evaluate(7) for curve in compat.fcurves_of(things(bpy)["keyed"])])


def _moved(bpy):
    for name in ("beam", "gentle path", "Grasp 1", "Control point 2", "Fixed base", "Goal"):
        thing = things(bpy)[name]
        thing.location, thing.scale = (0.2, 0.1, 0.05), (1.0, 2.0, 1.0)
        thing.rotation_euler = (0.1, 0.2, 0.3)

    def places():
        bpy.context.view_layer.update()
        return [(name, things(bpy)[name].location[:], things(bpy)[name].scale[:],
                 things(bpy)[name].rotation_euler[:])
                for name in ("beam", "gentle path", "Grasp 1", "Control point 2", "Fixed base",
                             "Goal")]
    return places


def _renamed(bpy):
    for name in ("beam", "gentle path", "Control point 1"):
        things(bpy)[name].name = f"my {name}"
    bpy.data.collections["beam"].name = "my branch"
    return lambda: ([name for name in sorted(things(bpy).keys())
                     if name.removeprefix("my ") in ("beam", "gentle path", "Control point 1")],
                    bpy.data.collections["my branch"].name)


def _keyed(bpy):
    thing = things(bpy)["Grasp 1"]
    for frame, height in ((1, 0.0), (30, 0.3)):
        thing.location.z = height
        thing.keyframe_insert("location", index=2, frame=frame)
        things(bpy)["beam"].rotation_euler.z = height
        things(bpy)["beam"].keyframe_insert("rotation_euler", frame=frame)
    compat = part("compat")
    return lambda: [[(curve.data_path, curve.evaluate(10)) for curve in compat.fcurves_of(thing)
                     if not curve.data_path.startswith("delta_")]
                    for thing in (things(bpy)["Grasp 1"], things(bpy)["beam"])]


def _coloured(bpy):
    mine = bpy.data.materials.new("mine")
    mine.diffuse_color = (1.0, 0.0, 0.0, 1.0)
    things(bpy)["beam"].data.materials[0] = mine
    things(bpy)["beam"].data.materials.append(bpy.data.materials.new("second"))
    things(bpy)["gentle path"].material_slots[0].link = "OBJECT"
    things(bpy)["gentle path"].material_slots[0].material = mine
    things(bpy)["Goal"].data.materials.clear()
    # Ours, in another colour.
    shader = things(bpy)["Grasp 1"].active_material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (0.0, 0.0, 1.0, 1.0)
    return lambda: [
        [(slot.material.name, slot.link) for slot in things(bpy)[name].material_slots]
        for name in ("beam", "gentle path", "Goal")] + [
        things(bpy)["Grasp 1"].active_material.node_tree.nodes["Principled BSDF"].inputs[
            "Base Color"].default_value[:]]


def _coloured_by(bpy):
    bpy.ops.limber.color_by(scalar="strain_energy")
    return lambda: (things(bpy)["beam"].data.color_attributes.active_color.name,
                    things(bpy)["beam"].active_material.name)


def _coloured_by_an_attribute(bpy):
    colours = things(bpy)["beam"].data.color_attributes
    colours.active_color = colours["strain_energy_color"]
    return lambda: things(bpy)["beam"].data.color_attributes.active_color.name


def _modifiers(bpy):
    things(bpy)["beam"].modifiers.new("Subsurf", "SUBSURF").levels = 2
    things(bpy)["gentle path"].modifiers.new("Wave", "WAVE")
    things(bpy)["beam"].modifiers["Limber motion"].name = "renamed"
    return lambda: ([(each.name, each.type) for each in things(bpy)["beam"].modifiers],
                    [each.name for each in things(bpy)["gentle path"].modifiers])


def _constraints_and_parents(bpy):
    empty = bpy.data.objects.new("handle", None)
    bpy.context.scene.collection.objects.link(empty)
    things(bpy)["beam"].parent = empty
    empty.constraints.new("COPY_LOCATION").target = things(bpy)["Grasp 1"]
    things(bpy)["Goal"].constraints.new("LIMIT_LOCATION")
    return lambda: (things(bpy)["beam"].parent.name,
                    things(bpy)["handle"].constraints[0].target.name,
                    [each.type for each in things(bpy)["Goal"].constraints])


def _nested(bpy):
    box = bpy.data.collections.new("box")
    bpy.context.scene.collection.children.link(box)
    branch = bpy.data.collections["beam"]
    bpy.context.scene.collection.children.unlink(branch)
    box.children.link(branch)
    elsewhere = bpy.data.collections.new("elsewhere")
    bpy.context.scene.collection.children.link(elsewhere)
    for name in ("beam", "gentle path"):
        branch.objects.unlink(things(bpy)[name])
        elsewhere.objects.link(things(bpy)[name])
    return lambda: ([each.name for each in bpy.data.collections],
                    [each.name for each in bpy.data.collections["box"].children],
                    sorted(bpy.data.collections["elsewhere"].objects.keys()))


def _second_scene(bpy):
    other = bpy.data.scenes.new("other")
    other.collection.children.link(bpy.data.collections["beam"])
    other.frame_start, other.frame_end = 3, 33
    return lambda: ({"beam", "Goal", "Grasp 1"} - set(bpy.data.scenes["other"].objects.keys()),
                    bpy.data.scenes["other"].frame_end)


def _instanced(bpy):
    copy = bpy.data.objects.new("instance", None)
    copy.instance_type, copy.instance_collection = "COLLECTION", bpy.data.collections["beam"]
    bpy.context.scene.collection.objects.link(copy)
    return lambda: things(bpy)["instance"].instance_collection.name


def _properties(bpy):
    things(bpy)["beam"]["species"] = "oak"
    things(bpy)["beam"].data["note"] = "mesh"
    bpy.data.collections["beam"]["tree"] = 3
    return lambda: (things(bpy)["beam"]["species"], things(bpy)["beam"].data["note"],
                    bpy.data.collections["beam"]["tree"])


def _visible(bpy):
    things(bpy)["gentle path"].hide_viewport = True
    things(bpy)["Rest shape"].hide_viewport = False
    things(bpy)["Rest shape"].display_type = "SOLID"
    things(bpy)["Goal"].hide_render = True
    return lambda: (things(bpy)["gentle path"].hide_viewport,
                    things(bpy)["Rest shape"].hide_viewport,
                    things(bpy)["Rest shape"].display_type, things(bpy)["Goal"].hide_render)


def _mesh_layers(bpy):
    thing = things(bpy)["beam"]
    thing.vertex_groups.new(name="tips").add([3, 4], 0.5, "REPLACE")
    thing.data.uv_layers.new(name="unwrapped")
    thing.data.attributes.new("wet", "FLOAT", "POINT").data[3].value = 0.25
    thing.shape_key_add(name="Basis")
    thing.shape_key_add(name="fat").data[0].co.x = 0.5
    return lambda: (thing.vertex_groups["tips"].weight(3), list(thing.data.uv_layers.keys()),
                    thing.data.attributes["wet"].data[3].value,
                    thing.data.shape_keys.key_blocks["fat"].data[0].co.x)


def _own_mesh(bpy):
    mine = bpy.data.meshes.new("arrow")
    mine.vertices.add(2)
    things(bpy)["Grasp 1"].data = mine
    return lambda: (things(bpy)["Grasp 1"].data.name, len(bpy.data.meshes["arrow"].vertices))


def _scene_settings(bpy):
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 5, 77
    scene.frame_set(4)
    scene.unit_settings.system, scene.render.fps = "IMPERIAL", 30
    scene.cursor.location = (1.0, 2.0, 3.0)
    return lambda: (scene.frame_start, scene.frame_end, scene.frame_current, scene.render.fps,
                    scene.unit_settings.system, scene.cursor.location[:])


def _as_opened(bpy):
    # Set by the first showing: no later one changes it.
    return lambda: (bpy.context.scene.frame_start, bpy.context.scene.frame_end,
                    things(bpy)["beam"].data.color_attributes.active_color_name)


def _timing(bpy):
    bpy.ops.limber.retime(frame_start=11, speed=0.5)
    animation = part("bridge.animation")
    surface = things(bpy)["beam"]
    return lambda: animation.timing_of(animation.motion_of(surface))[0]


def _selection(bpy):
    lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "POINT"))
    bpy.context.scene.collection.objects.link(lamp)
    part("branch.branches").activate(bpy.context.scene, lamp)
    return lambda: (bpy.context.view_layer.objects.active.name,
                    [thing.name for thing in bpy.context.selected_objects])


def _copied(bpy):
    surface = things(bpy)["beam"]
    copy = surface.copy()
    copy.data = surface.data.copy()
    copy.name = "a copy"
    bpy.data.collections["beam"].objects.link(copy)
    # It sorts before the original.
    points = part("bridge.meshes").positions
    return lambda: (points(things(bpy)["a copy"].data).tolist(),
                    things(bpy)["beam"] == part("branch.branches").find_surface(bpy.context.scene))


def _linked(bpy):
    path = bpy.app.tempdir + "theirs.blend"
    theirs = bpy.data.objects.new("theirs", bpy.data.meshes.new("theirs"))
    bpy.data.libraries.write(path, {theirs})
    bpy.data.objects.remove(theirs)
    with bpy.data.libraries.load(path, link=True) as (_, mine):
        mine.objects = ["theirs"]
    bpy.data.collections["beam"].objects.link(mine.objects[0])
    override = mine.objects[0].override_create()
    override.name = "overridden"
    bpy.context.scene.collection.objects.link(override)
    override.location.x = 0.4
    return lambda: (things(bpy)["theirs", path].users_collection[0].name,
                    things(bpy)["overridden"].override_library.reference.library.filepath,
                    things(bpy)["overridden"].location.x)


def _edit_mode(bpy):
    cube = bpy.data.objects.new("edited", bpy.data.meshes.new("edited"))
    bpy.context.scene.collection.objects.link(cube)
    bpy.context.view_layer.objects.active = cube
    bpy.ops.object.mode_set(mode="EDIT")
    return lambda: (bpy.context.mode, bpy.context.view_layer.objects.active.name)


THINGS = (_own_object, _own_object_with_keys, _moved, _renamed, _keyed, _coloured, _coloured_by,
          _coloured_by_an_attribute, _modifiers, _constraints_and_parents, _nested, _second_scene,
          _instanced, _properties, _visible, _mesh_layers, _own_mesh, _scene_settings,
          _as_opened, _timing, _selection, _copied, _linked, _edit_mode)


@pytest.fixture(scope="module")
def states(tmp_path_factory, write_pc2):
    """The beam's folder as each of seven stages leaves it, one after the other, by its name."""
    home = tmp_path_factory.mktemp("states")
    beam = make_beam_branch(home / "beam.branch")
    height, found = np.linspace(0.0, 0.6, 13), {}

    def keep(stage):
        found[stage] = shutil.copytree(beam.folder, home / stage)
    keep("open")
    for stage, factor in (("reconstruct", 1.2), ("estimate", 0.7)):
        result_of(beam.folder, stage=stage, mesh=beam.mesh.with_data(
            cell_data={"young": factor * beam.mesh.cell_data["young"]}))
        keep(stage)
    with Branch.open(beam.folder).stage("axes") as made:
        Skeleton.from_edges(np.column_stack([0 * height, 0 * height, height]), np.arange(-1, 12),
                            0.012 - height / 0.6 * 0.007).write_swc(made.path("skeleton.swc"))
    keep("skeleton")
    assert call(["target", "--at", "0", "0", "0.3", "--", str(beam.folder), "bud"]) == 0
    keep("target")
    with Branch.open(beam.folder).stage("plan:to-goal", reads=["mesh.vtu"]) as made:
        write_plan(made, beam.path[[0, 2, 5]])
        write_pc2(made.path("frames/to-goal.pc2"), beam.frames[[0, 2, 5]])
        made.path("frames/to-goal.json").write_text(json.dumps(
            {"frame_count": 3, "energies_j": [0.0, 0.004, 0.008]}))
        np.savez(made.path("frames/to-goal.npz"),
                 strain_energy_density_j_m3=beam.frames[[0, 2, 5], :, 2])
    keep("plan")
    result_of(beam.folder, stage="simulate", write_pc2=write_pc2,
              frames=np.repeat(beam.frames, 2, axis=0))
    keep("simulate")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("thing", THINGS, ids=lambda thing: thing.__name__.strip("_"))
def test_a_thing_of_the_users_stays(bpy, worker_here, states, tmp_path, thing):
    """After each of seven stages. The objects are the same ones, and none is doubled."""
    folder = shutil.copytree(states["open"], tmp_path / "beam.branch")
    bpy.ops.limber.open_result(directory=str(folder))
    surface = part("branch.branches").find_surface(bpy.context.scene)
    seen, kept = thing(bpy), []
    before, count = seen(), sum("limber_id" not in one for one in things(bpy))
    for stage, made in states.items():
        shutil.rmtree(folder)
        shutil.copytree(made, folder)
        bpy.context.scene.limber.scene.motion = "swing" if stage == "simulate" else ""
        assert bpy.ops.limber.open_result(directory=str(folder)) == {"FINISHED"}
        ours = [one["limber_id"] for one in things(bpy) if "limber_id" in one]
        # A copy of ours is the user's from then on.
        is_single = len(set(ours)) == len(ours) and (
            len(things(bpy)) - len(ours) == count + (thing is _copied))
        if seen() == before and is_single:
            kept.append(stage)
    assert kept == list(states) and len(kept) == 7
    assert part("branch.branches").find_surface(bpy.context.scene) == surface


@pytest.mark.slow
def test_another_mesh_comes_into_the_same_object(bpy, shown, beam):
    """Reconstructed anew: modifiers, material, place and name of the user's are around it; the
    motion, which belonged to the other mesh, is gone, with all that belonged to the plan."""
    from limber.geometry.tets.tree_sweep import straight_beam

    surface = part("branch.branches").find_surface(bpy.context.scene)
    mesh, mine = surface.data, bpy.data.materials.new("mine")
    surface.modifiers.new("Subsurf", "SUBSURF")
    surface.data.materials[0] = mine
    high = [vertex.index for vertex in mesh.vertices if vertex.co.z > 0.4]
    surface.vertex_groups.new(name="high").add(high, 0.5, "REPLACE")
    surface.location, surface.name = (0.1, 0.0, 0.0), "mine"
    child = bpy.data.objects.new("hangs on a path", None)
    bpy.context.scene.collection.objects.link(child)
    child.parent = things(bpy)["gentle path"]
    things(bpy)["gentle path"].location = (0.0, 0.3, 0.0)
    bpy.context.view_layer.update()
    longer = straight_beam(0.7, 0.012, 0.005, slice_count=20, grasp_fraction=0.67)
    longer = longer.with_data(cell_data={"young": np.full(len(longer.tets), 1e7)})
    shutil.rmtree(beam.folder)
    make_beam_branch(beam.folder, plan=False)
    result_of(beam.folder, stage="reconstruct", mesh=longer)
    assert shown() == surface and surface.data == mesh
    assert surface.name == "mine" and surface.location.x == pytest.approx(0.1)
    assert [each.type for each in surface.modifiers] == ["SUBSURF"]
    assert list(mesh.materials) == [mine]
    assert part("bridge.meshes").positions(mesh)[:, 2].max() == pytest.approx(0.7, abs=1e-3)
    weights = [sum(one.weight for one in vertex.groups) for vertex in mesh.vertices]
    assert {weights[vertex.index] for vertex in mesh.vertices if vertex.co.z > 0.45} == {0.5}
    assert not any(weights[vertex.index] for vertex in mesh.vertices if vertex.co.z < 0.35)
    assert not {"gentle path", "shortest path", "Rest shape"} & set(things(bpy).keys())
    assert child.matrix_world.translation.y == pytest.approx(0.3), "it keeps its place"


@pytest.mark.slow
def test_nothing_piles_up(bpy, shown, beam):
    """As many data blocks after ten openings as after one; none of ours is unused."""
    bpy.ops.limber.color_by(scalar="strain_energy")
    bpy.ops.limber.set_up_picture()
    bpy.ops.limber.turntable(frames=4)
    shown()
    kinds = ("meshes", "materials", "actions", "objects", "collections", "curves", "lights",
             "cameras", "node_groups", "worlds")
    before = {kind: len(getattr(bpy.data, kind)) for kind in kinds}
    for _ in range(10):
        shown()
        bpy.ops.limber.set_up_picture()
        bpy.ops.limber.turntable(frames=4)
    assert {kind: len(getattr(bpy.data, kind)) for kind in kinds} == before
    assert not [mesh.name for mesh in bpy.data.meshes if not mesh.users]


@pytest.mark.slow
def test_the_motion_goes_before_a_subdivision(bpy, worker_here, bare_beam, beam):
    """Put around a branch that has no motion yet: the motion moves the vertices below it."""
    show = bpy.ops.limber.open_result
    show(directory=str(bare_beam.folder))
    surface = part("branch.branches").find_surface(bpy.context.scene)
    surface.modifiers.new("Subsurf", "SUBSURF")
    shutil.copytree(beam.folder, bare_beam.folder, dirs_exist_ok=True)
    show(directory=str(bare_beam.folder))
    assert [each.type for each in surface.modifiers] == ["MESH_CACHE", "SUBSURF"]
    assert bpy.context.scene.frame_end == 250, "not at each stage"
    bpy.ops.limber.play()
    assert (bpy.context.scene.frame_start, bpy.context.scene.frame_end) == (1, len(beam.frames))


@pytest.mark.slow
def test_a_goal_moved_by_hand_waits_for_its_plan(bpy, shown, beam):
    """Another result is shown meanwhile: ball and setting stay, and a ball without any plan."""
    ball, plan = things(bpy)["Goal"], bpy.context.scene.limber.plan
    ball.location = (0.1, 0.2, 0.3)
    bpy.context.view_layer.update()
    shown()
    assert list(ball.location) == pytest.approx([0.1, 0.2, 0.3])
    assert plan.use_goal and list(plan.goal) == pytest.approx([0.1, 0.2, 0.3])


@pytest.mark.slow
def test_a_bad_motion_costs_nothing(bpy, shown, beam, write_pc2):
    """Of another mesh: refused with the reason, and all is there as before."""
    scene_data(Branch.open(beam.folder)).write(beam.folder / "data.npz")
    data = part("show.scene_data").read_scene_data(beam.folder / "data.npz")
    write_pc2(beam.folder / "frames/to-goal.pc2", beam.frames[:, :-1])
    names = set(things(bpy).keys())
    with pytest.raises(ValueError, match="belongs to another mesh"):
        part("show.scene").show_branch(bpy.context.scene, data)
    assert set(things(bpy).keys()) == names


def test_a_scan_is_put_to_its_branch_once(bpy, beam, tmp_path):
    """Where the user moves it then, it stays, until a result lies elsewhere."""
    scene_data(Branch.open(beam.folder)).write(tmp_path / "data.npz")
    data = part("show.scene_data").read_scene_data(tmp_path / "data.npz")
    scan = bpy.data.objects.new("scan", None)
    scan["limber_scan_sha256"] = data.info["source"]["sha256"] = "abc"
    bpy.context.scene.collection.objects.link(scan)
    place = part("show.scene").place_scans
    assert place(bpy.context.scene, data) == 1
    scan.location.x = 5.0
    assert place(bpy.context.scene, data) == 0 and scan.location.x == 5.0
    data.info["alignment"][0][3] = 2.0
    assert place(bpy.context.scene, data) == 1 and scan.location.x == 2.0


@pytest.mark.slow
def test_a_chosen_colour_comes_back_with_its_values(bpy, shown, beam, write_pc2):
    """A motion without it between: its own first one is shown meanwhile."""
    surface = things(bpy)["beam"]
    bpy.ops.limber.color_by(scalar="strain_energy")
    with Branch.open(beam.folder).stage("simulate", reads=["mesh.vtu"]) as made:
        write_pc2(made.path("frames/bare.pc2"), beam.frames)
        made.path("frames/bare.json").write_text(json.dumps({"rate": 24.0, "times_s": [
            number / 24 for number in range(len(beam.frames))]}))
    seen = []
    for motion in ("bare", ""):
        bpy.context.scene.limber.scene.motion = motion
        shown()
        seen.append(surface.data.color_attributes.active_color.name)
    assert seen == ["young_color", "strain_energy_color"]
