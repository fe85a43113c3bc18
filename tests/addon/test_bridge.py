"""Arrays go to Blender's data and come back the same; wrong ones are refused."""


import numpy as np
import pytest
from tests.addon.conftest import part


@pytest.fixture()
def meshes(addon):
    return part("bridge.meshes")


@pytest.fixture()
def animation(addon):
    return part("bridge.animation")


def _random_mesh(meshes, seed=3, count=50):
    generator = np.random.default_rng(seed)
    vertices = generator.normal(size=(count, 3))
    faces = np.array([[i, i + 1, i + 2] for i in range(count - 2)])
    return vertices, faces, meshes.new_mesh("random", vertices, faces)


def test_mesh_round_trip(meshes):
    """Positions, triangles and their order come back as they went."""
    vertices, faces, mesh = _random_mesh(meshes)
    np.testing.assert_allclose(meshes.positions(mesh), vertices, rtol=1e-6)
    np.testing.assert_array_equal(meshes.faces(mesh), faces)
    assert mesh.validate() is False, "Blender found nothing to repair"
    meshes.set_positions(mesh, vertices + 1.0)
    np.testing.assert_allclose(meshes.positions(mesh), vertices + 1.0, rtol=1e-6)


def test_attribute_round_trip(meshes):
    """Scalars and colours come back by name, and can be written anew."""
    _, _, mesh = _random_mesh(meshes)
    young = np.geomspace(1e6, 1e9, 50)
    for values in (young, young[::-1]):
        meshes.set_values(mesh, "young", values)
        np.testing.assert_allclose(meshes.values_of(mesh, "young"), values, rtol=1e-6)
    assert mesh.attributes["young"].data_type == "FLOAT"
    colours = np.random.default_rng(1).random((50, 4))
    meshes.set_values(mesh, "young_color", colours, "FLOAT_COLOR")
    found = np.empty(200, np.float32)
    mesh.color_attributes.active_color.data.foreach_get("color", found)
    np.testing.assert_allclose(found.reshape(-1, 4), colours, atol=1e-6)


def test_point_cloud_is_a_mesh_of_points(meshes):
    """A mesh without faces holds every point."""
    points = np.random.default_rng(0).random((1000, 3))
    mesh = meshes.new_mesh("cloud", points)
    assert len(mesh.vertices) == 1000
    assert len(mesh.polygons) == 0


@pytest.mark.parametrize(("vertices", "faces"), [
    (np.zeros((4, 2)), None),
    (np.array([[0.0, 0.0, np.nan]]), None),
    (np.zeros((3, 3)), np.array([[0, 1, 3]])),
    (np.zeros((3, 3)), np.array([[0, 1, -1]])),
    (np.zeros((3, 3)), np.array([[0, 1, 2, 0]])),
])
def test_wrong_arrays_are_refused(meshes, vertices, faces):
    """Wrong shapes, NaN and indices out of range raise instead of reaching Blender."""
    with pytest.raises(ValueError):
        meshes.new_mesh("wrong", vertices, faces)


def test_wrong_attributes_are_refused(meshes):
    """An attribute of another length or with NaN raises."""
    _, _, mesh = _random_mesh(meshes)
    with pytest.raises(ValueError, match="49 values for 50"):
        meshes.set_values(mesh, "young", np.ones(49))
    with pytest.raises(ValueError, match="not finite"):
        meshes.set_values(mesh, "young", np.full(50, np.nan))
    with pytest.raises(ValueError):
        meshes.set_positions(mesh, np.zeros((49, 3)))


def test_a_tube_lies_about_its_points(addon):
    """Every vertex at the radius of a straight path; one that is not finite is refused."""
    curves = part("bridge.curves")
    meshes = part("bridge.meshes")
    points = np.column_stack([np.zeros(9), np.zeros(9), np.linspace(0, 1, 9)])
    tube = meshes.positions(curves.new_tube("path", points, 0.01))
    np.testing.assert_allclose(np.linalg.norm(tube[:, :2], axis=1), 0.01, rtol=1e-4)
    assert (tube[:, 2].min(), tube[:, 2].max()) == (0.0, 1.0)
    with pytest.raises(ValueError):
        curves.new_tube("path", points * np.nan, 0.01)


def test_damaged_caches_are_refused(animation, meshes, beam, bpy, tmp_path):
    """Missing, cut short, foreign, of another mesh: Blender would show the rest shape silently."""
    thing = bpy.data.objects.new("beam", meshes.new_mesh("beam", beam.surface))
    whole = (beam.folder / "frames" / "to-goal.pc2").read_bytes()
    for name, content, words in (("cut", whole[:-1], "truncated"),
                                 ("head", whole[:20], "not a PC2"),
                                 ("other", b"x" * len(whole), "not a PC2")):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(animation.CacheError, match=words):
            animation.attach_cache(thing, path)
    with pytest.raises(animation.CacheError, match="cannot be read"):
        animation.attach_cache(thing, tmp_path / "missing.pc2")
    smaller = bpy.data.objects.new("small", meshes.new_mesh("small", beam.surface[:-1]))
    with pytest.raises(animation.CacheError, match="another mesh"):
        animation.attach_cache(smaller, beam.folder / "frames" / "to-goal.pc2")
    assert not thing.modifiers
    assert not smaller.modifiers


def test_log_colours_in_the_material(addon):
    """The material maps the attribute's logarithm over its range."""
    materials = part("bridge.materials")
    stops = [[0.0, 0, 0, 0], [0.5, 0.2, 0.3, 0.4], [1.0, 1, 1, 1]]
    material = materials.scalar_material("E", "young", low=1e6, high=1e9, log=True, stops=stops)
    nodes = {node.type: node for node in material.node_tree.nodes}
    assert nodes["ATTRIBUTE"].attribute_name == "young"
    assert nodes["MAP_RANGE"].inputs["From Min"].default_value == pytest.approx(6.0)
    assert nodes["MAP_RANGE"].inputs["From Max"].default_value == pytest.approx(9.0)
    ramp = nodes["VALTORGB"].color_ramp.elements
    assert [element.position for element in ramp] == pytest.approx([0.0, 0.5, 1.0])
    assert list(ramp[1].color)[:3] == pytest.approx([0.2, 0.3, 0.4])
