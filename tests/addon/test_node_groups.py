"""The modifiers of geometry nodes: assets of each file that shows a branch."""

import numpy as np
import pytest
from tests.addon.conftest import part

pytestmark = [pytest.mark.usefixtures("worker_here"), pytest.mark.slow]


@pytest.fixture()
def surface(bpy, beam, worker_here):
    """The beam's surface, in its last frame: x has grown by the square of z."""
    bpy.ops.limber.open_result(directory=str(beam.folder))
    bpy.context.scene.frame_set(len(beam.frames))
    return part("branch.branches").find_surface(bpy.context.scene)


def put_group(bpy, thing, title, **inputs):
    """Put a group around a thing, with inputs by name; ``_`` is a space, ``by_`` an attribute."""
    modifier = thing.modifiers.new(title, "NODES")
    modifier.node_group = bpy.data.node_groups[title]
    names = {item.name: item.identifier for item in modifier.node_group.interface.items_tree
             if item.in_out == "INPUT"}
    for name, value in inputs.items():
        key = names[name.removeprefix("by_")]
        if hasattr(modifier, "properties") and hasattr(modifier.properties, "inputs"):
            given = getattr(modifier.properties.inputs, key)
            if name.startswith("by_"):
                given.type, given.attribute_name = "ATTRIBUTE", value
            else:
                given.value = value
        elif name.startswith("by_"):
            modifier[f"{key}_attribute_name"], modifier[f"{key}_use_attribute"] = value, True
        else:
            modifier[key] = value
    thing.update_tag()
    return modifier


def shape_of(bpy, thing):
    return thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).data


def places_of(bpy, thing):
    return part("bridge.meshes").positions(shape_of(bpy, thing))


def own(bpy, points, faces=()):
    """A mesh of the user's, in the scene."""
    mesh = bpy.data.meshes.new("mine")
    mesh.from_pydata(points, [], faces)
    thing = bpy.data.objects.new("mine", mesh)
    bpy.context.scene.collection.objects.link(thing)
    return thing


@pytest.mark.parametrize("scalar", ["young", "strain_energy"])
def test_it_colours_as_the_worker_does(bpy, surface, scalar):
    """By the attribute of the surface, on a logarithmic or an even scale: the worker's colours."""
    scale = part("branch.branches").info_of(surface)["scalars"][scalar]
    title = f"Limber Colours, {scale['colours']}"
    group = bpy.data.node_groups[title]
    assert group.asset_data is not None and group.is_modifier
    known = part("bridge.node_groups").colour_group(scale["colours"], scale["stops"])
    assert known == group, "once a file"
    surface.modifiers.clear()
    put_group(bpy, surface, title, Low=scale["low"], High=scale["high"],
              Logarithmic=scale["log"], by_Quantity=scalar)
    shown = shape_of(bpy, surface)
    values_of = part("bridge.meshes").values_of
    assert np.ptp(values_of(surface.data, scalar)) > 0
    np.testing.assert_allclose(values_of(shown, "limber_color"),
                               values_of(surface.data, f"{scalar}_color"), atol=2e-3)
    drawn = shown.materials[shown.polygons[0].material_index]
    assert drawn.name == "limber_color"


def test_bark_bends_with_the_branch(bpy, surface, beam):
    """A model on its surface moves as that does, and what is beside it keeps its distance and is
    turned: by the slope there, which is twice the height. The branch may have been moved."""
    faces = part("bridge.meshes").faces(surface.data).tolist()
    bark = own(bpy, beam.surface.tolist(), faces)
    height = np.array([0.15, 0.3, 0.45])
    width = np.interp(height, [0.0, 0.6], [0.012, 0.005])
    points = np.column_stack([width + 0.03, 0 * height, height])
    beside = own(bpy, points.tolist())
    surface.location = bark.location = beside.location = (0.3, -0.1, 0.2)
    for thing in (bark, beside):
        put_group(bpy, thing, "Limber Motion", Branch=surface)
    np.testing.assert_allclose(places_of(bpy, bark), beam.frames[-1], atol=2e-6)
    slope = np.arctan(2 * height)
    expected = np.column_stack([height**2 + width + 0.03 * np.cos(slope), 0 * height,
                                height - 0.03 * np.sin(slope)])
    # The beam has twelve slices: its faces are flat between them.
    np.testing.assert_allclose(places_of(bpy, beside), expected, atol=3e-3)
    bpy.context.scene.frame_set(1)
    np.testing.assert_allclose(places_of(bpy, beside), points, atol=1e-6)


def test_scattered_leaves_turn_with_the_branch(bpy, surface):
    """Instances too, each about its own place; without a branch they stay."""
    leaf = own(bpy, [(0, 0, 0), (0.01, 0, 0), (0, 0, 0.01)], [(0, 1, 2)])
    twig = own(bpy, [(0.009, 0.0, 0.3)])
    tree = bpy.data.node_groups.new("scatter", "GeometryNodeTree")
    tree.is_modifier = True
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    given, spread, seen, result = (tree.nodes.new(kind) for kind in (
        "NodeGroupInput", "GeometryNodeInstanceOnPoints", "GeometryNodeObjectInfo",
        "NodeGroupOutput"))
    seen.inputs["Object"].default_value = leaf
    for source, target in ((given.outputs[0], spread.inputs["Points"]),
                           (seen.outputs["Geometry"], spread.inputs["Instance"]),
                           (spread.outputs[0], result.inputs[0])):
        tree.links.new(source, target)
    put_group(bpy, twig, "scatter")

    def placed():
        graph = bpy.context.evaluated_depsgraph_get()
        return next(each.matrix_world.copy() for each in graph.object_instances
                    if each.is_instance and each.parent and each.parent.original == twig)
    motion = put_group(bpy, twig, "Limber Motion")
    assert placed().translation.z == pytest.approx(0.3) and placed().to_euler().y == 0.0
    twig.modifiers.remove(motion)
    put_group(bpy, twig, "Limber Motion", Branch=surface)
    assert placed().translation.x == pytest.approx(0.3**2 + 0.009, abs=2e-3)
    assert placed().to_euler().y == pytest.approx(np.arctan(0.6), abs=0.1)


def test_styles_of_skeleton_and_scan(bpy, registered, tmp_path):
    """Wood is as thick as the skeleton's radius, wires are as thick as they are told, and a scan
    has a ball for each point, in its colour."""
    part("bridge.node_groups").add_styles()
    count = len(bpy.data.node_groups)
    part("bridge.node_groups").add_styles()
    assert len(bpy.data.node_groups) == count, "once a file"
    skeleton = own(bpy, [(0, 0, 0), (0, 0, 1)])
    skeleton.data.edges.add(1)
    skeleton.data.edges[0].vertices = (0, 1)
    part("bridge.meshes").set_values(skeleton.data, "radius", np.array([0.2, 0.1]))
    for title, given, radii in (
            ("Limber Wood", {"by_Radius": "radius", "Sides": 64}, (0.2, 0.1)),
            ("Limber Wood", {"by_Radius": "radius", "Sides": 64, "Scale": 2.0}, (0.4, 0.2)),
            ("Limber Wires", {"Radius": 0.03, "Sides": 64}, (0.03, 0.03))):
        skeleton.modifiers.clear()
        put_group(bpy, skeleton, title, **given)
        shape = shape_of(bpy, skeleton)
        place = places_of(bpy, skeleton)
        for height, radius in zip((0.0, 1.0), radii, strict=True):
            end = place[np.abs(place[:, 2] - height) < 1e-6]
            assert np.hypot(end[:, 0], end[:, 1]).max() == pytest.approx(radius, rel=1e-3)
        assert shape.materials[0].name == title
    scan = own(bpy, [(0, 0, 0), (1, 0, 0)])
    part("bridge.meshes").set_values(scan.data, "scan_color", np.array([
        [1, 0, 0, 1], [0, 1, 0, 1.0]]), "BYTE_COLOR")
    put_group(bpy, scan, "Limber Points", by_Colour="scan_color", Radius=0.05)
    if hasattr(scan, "evaluated_geometry"):
        shown = scan.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
        colours = np.empty(8, np.float32)
        shown.pointcloud.attributes["limber_color"].data.foreach_get("color", colours)
        assert colours.tolist() == [1, 0, 0, 1, 0, 1, 0, 1]
        assert shown.pointcloud.points[1].radius == pytest.approx(0.05)
