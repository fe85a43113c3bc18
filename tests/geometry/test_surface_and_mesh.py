"""Surfaces and tetrahedra: closed, of the right volume, sound elements; and the marks on them."""

from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.grown import grown

from limber.core.errors import MeshingError
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import bending_factor, polygon_factor, rings
from limber.geometry.surface.surface import Surface, check_surface, distance_to_surface
from limber.geometry.surface.tubes import branch_surface
from limber.geometry.tets import tetrahedra
from limber.geometry.tets.tet_mesh import (
    TetMesh,
    base_nodes,
    dihedral_angles,
    mark,
    measure_quality,
    radius_ratios,
)
from limber.geometry.tets.tetrahedra import MeshSettings, mesh_branch, tetrahedralise
from limber.geometry.tets.tree_sweep import curved_beam, split_wedges, straight_beam, sweep_tree
from limber.mechanics import BranchModel, solve_static


def test_branch_surface_is_closed_and_of_the_right_volume(y_skeleton):
    """Watertight, oriented, uncrossed; the volume is that of the round cylinders."""
    surface = branch_surface(y_skeleton)
    check = check_surface(surface)
    assert check.valid and check.piece_count == 1
    stem = np.pi * 0.5 * (0.012**2 + 0.012 * 0.008 + 0.008**2) / 3
    twig = np.pi * 0.006**2 * (0.2 - 0.01 / 0.8)  # from the stem's side on
    round_volume = stem + twig + 2 / 3 * np.pi * (0.008**3 + 0.006**3)
    assert surface.volume == pytest.approx(round_volume, rel=0.03)


def _forked(*twigs: tuple[float, float, float, float]) -> Skeleton:
    """A stem of radius 10 mm with twigs: height [m], lean and turn [degrees], radius [m]."""
    stem = np.column_stack([np.zeros(41), np.zeros(41), np.linspace(0, 0.6, 41)])
    nodes, parent, radius, count = [stem], [np.arange(41) - 1], [np.full(41, 0.01)], 41
    for height, lean, turn, thick in twigs:
        lean, turn = np.deg2rad([lean, turn])
        way = [np.sin(lean) * np.cos(turn), np.sin(lean) * np.sin(turn), np.cos(lean)]
        at = int(np.argmin(np.abs(stem[:, 2] - height)))
        nodes.append(stem[at] + np.linspace(0.015, 0.2, 10)[:, None] * way)
        parent.append(np.concatenate([[at], count + np.arange(9)]))
        radius.append(np.full(10, thick))
        count += 10
    return Skeleton.from_edges(np.vstack(nodes), np.concatenate(parent), np.concatenate(radius))


@pytest.mark.parametrize(("name", "twigs"), [
    ("acute", [(0.2, 12, 30, 0.006)]),
    ("equally thick", [(0.2, 40, 0, 0.01)]),
    ("thicker than the stem", [(0.2, 60, 10, 0.013)]),
    ("far thinner than the stem", [(0.2, 70, 10, 0.0012)]),
    ("opposite", [(0.2, 50, 0, 0.006), (0.2, 50, 180, 0.006)]),
    ("crowded", [(0.2 + 0.015 * k, 35 + 8 * k, 100 * k, 0.004 + 0.001 * k) for k in range(5)]),
    ("at the root", [(0.0, 60, 20, 0.006)]),
    ("hanging", [(0.3, 150, 40, 0.006)]),
    ("hanging below the root", [(0.15, 170, 40, 0.003), (0.12, 140, 0, 0.005)]),
])
def test_every_fork_is_one_solid(name, twigs):
    """Closed, oriented and uncrossed at any angle, thickness and company."""
    check = check_surface(branch_surface(_forked(*twigs)))
    assert check.valid and check.piece_count == 1, name


def test_sharp_bend_does_not_cross_itself():
    """A hairpin tighter than the branch is thick still gives a valid surface."""
    angle = np.linspace(0, np.pi, 12)
    bend = np.column_stack([0.006 * (1 - np.cos(angle)), np.zeros(12), 0.2 + 0.006 * np.sin(angle)])
    up = np.column_stack([np.zeros(10), np.zeros(10), np.linspace(0, 0.195, 10)])
    down = np.column_stack([np.full(10, 0.012), np.zeros(10), np.linspace(0.195, 0.1, 10)])
    nodes = np.vstack([up, bend, down])
    skeleton = Skeleton.from_edges(nodes, np.arange(len(nodes)) - 1, np.full(len(nodes), 0.01))
    assert check_surface(branch_surface(skeleton)).valid


def test_check_names_the_place():
    """A hole and a crossing are found where they are."""
    surface = branch_surface(Skeleton.from_edges(
        np.array([[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]]), np.array([-1, 0, 1]), np.full(3, 0.01)))
    holed = check_surface(Surface(surface.vertices, surface.faces[1:]))
    assert not holed.watertight and len(holed.open_edges) == 3
    with pytest.raises(MeshingError, match="open edges or edges with more than two faces"):
        holed.require()
    other = Surface(surface.vertices[:, [2, 1, 0]] - [0.1, 0.003, -0.1], surface.faces[:, ::-1])
    both = Surface(np.vstack([surface.vertices, other.vertices]),
                   np.vstack([surface.faces, other.faces + len(surface.vertices)]))
    crossing = check_surface(both)
    assert len(crossing.crossings) > 4
    assert np.linalg.norm(crossing.crossings - [0, 0, 0.1], axis=1).max() < 0.03


def test_sweep_is_sound_repeatable_and_keeps_volume(forked_branch):
    """The forked sweep: closed boundary, no flat elements, volume within 2 %, the same twice."""
    first = mesh_branch(forked_branch.skeleton, MeshSettings(mesher="sweep"))
    again = mesh_branch(forked_branch.skeleton, MeshSettings(mesher="sweep"))
    np.testing.assert_array_equal(first.mesh.nodes, again.mesh.nodes)
    assert not first.left_out and first.mesh.is_quadratic
    quality = measure_quality(first.mesh, forked_branch.surface.volume, forked_branch.skeleton)
    assert quality.volume_ratio == pytest.approx(1, abs=0.02)
    assert quality.min_dihedral_deg > 3 and first.mesh.volumes.min() > 0
    boundary = check_surface(Surface(first.mesh.nodes, first.mesh.surface_faces()))
    assert boundary.watertight and boundary.piece_count == 1


@pytest.mark.parametrize(("thick", "thin"), [(0.005, 0.005), (0.008, 0.003)])
def test_default_mesh_bends_as_beam_theory_says(thick, thin):
    """A cantilever's tip moves under a force as Euler and Bernoulli have it, within 0.5 %."""
    along = np.linspace(0, 0.5, 40)
    skeleton = Skeleton.from_edges(np.column_stack([0 * along, 0 * along, along]),
                                   np.arange(40) - 1, np.linspace(thick, thin, 40))
    mesh = mesh_branch(skeleton).mesh
    length = mesh.nodes[:, 2].max()
    tip = np.flatnonzero(mesh.nodes[:, 2] > length - 1e-9)
    model = BranchModel(mesh, young=1e8, poisson=0.35, density=900, gravity=None,
                        fixed=mesh.nodes[:, 2] < 1e-9, material="linear")
    place = np.linspace(0, length, 4001)
    radius = np.interp(place, [0, 0.5], [thick, thin])
    share = (length - place)**2 / (1e8 * np.pi * radius**4 / 4)
    moved = 1e-3 * np.sum((share[1:] + share[:-1]) / 2 * np.diff(place))
    for k in (0, 1):
        forces = np.zeros((mesh.node_count, 3))
        forces[tip, k] = 1e-3 / len(tip)
        displacement = solve_static(model, nodal_forces=forces).require().displacement
        assert displacement[tip, k].mean() == pytest.approx(moved, rel=0.005)


@pytest.mark.parametrize("sides", [4, 6, 9])
def test_swept_sections_have_the_circles_second_moment(sides):
    """Second moment of area of the polygon, by Green's theorem, is a unit circle's."""
    corner = rings(np.zeros((1, 3)), np.ones(1), np.eye(3)[:1], np.eye(3)[1:2], sides,
                   bending_factor(sides))[0, :, :2]
    after = np.roll(corner, -1, axis=0)
    twice = corner[:, 0] * after[:, 1] - after[:, 0] * corner[:, 1]
    for k in (0, 1):
        moment = (twice * (corner[:, k]**2 + corner[:, k] * after[:, k] + after[:, k]**2)).sum()
        assert moment / 12 == pytest.approx(np.pi / 4, rel=1e-12)


def test_quality_states_the_distance_from_the_surface(forked_branch):
    """The mesh of the default sweep lies within a tenth of the radius of the round cylinders."""
    skeleton = forked_branch.skeleton
    surface = branch_surface(skeleton)
    quality = measure_quality(mesh_branch(skeleton).mesh, surface.volume, skeleton, surface)
    assert 1 <= quality.elements_across < 1.6
    assert 0.02 < quality.surface_distance_mean < 0.1
    assert quality.fork_distance_mean < 0.12 and quality.fork_distance_max < 0.5
    assert quality.surface_distance_max_m < 0.5 * skeleton.radius.max()


def test_distance_to_a_surface_is_exact():
    """Points around a box: distances from faces, edges and corners, inside and out."""
    import trimesh

    box = trimesh.creation.box((2, 2, 6))
    surface = Surface(np.asarray(box.vertices, float), np.asarray(box.faces))
    points = np.random.default_rng(2).uniform(-4, 4, (400, 3))
    excess = np.abs(points) - [1, 1, 3]
    outside = np.linalg.norm(np.maximum(excess, 0), axis=1)
    expected = np.where(outside > 0, outside, -excess.max(axis=1))
    np.testing.assert_allclose(distance_to_surface(points, surface), expected, atol=1e-12)


def test_sweep_joins_twigs_all_around():
    """Twigs in many directions, angles and sizes all join the stem."""
    stem = np.column_stack([np.zeros(41), np.zeros(41), np.linspace(0, 1.0, 41)])
    nodes, parent, radius = [stem], [np.arange(41) - 1], [np.full(41, 0.012)]
    count = 41
    for k, at in enumerate(range(5, 36, 5)):
        turn, lean = 2.4 * k, 0.4 + 0.12 * k
        direction = np.array([np.sin(lean) * np.cos(turn), np.sin(lean) * np.sin(turn),
                              np.cos(lean)])
        twig = stem[at] + np.linspace(0.02, 0.25, 12)[:, None] * direction
        nodes.append(twig)
        parent.append(np.concatenate([[at], count + np.arange(11)]))
        radius.append(np.full(12, 0.003 + 0.001 * k))
        count += 12
    skeleton = Skeleton.from_edges(np.vstack(nodes), np.concatenate(parent), np.concatenate(radius))
    meshed = mesh_branch(skeleton, MeshSettings(mesher="sweep"))
    assert not meshed.left_out
    assert dihedral_angles(meshed.mesh).min() > 2


def test_sweep_joins_the_whorls_of_a_conifer():
    """Twigs of a whorl share a slice; one after the other they would not fit on the stem."""
    stem = np.column_stack([np.zeros(49), np.zeros(49), np.linspace(0, 0.6, 49)])
    nodes, parent = [stem], [np.arange(49) - 1]
    radius, count = [np.linspace(0.008, 0.003, 49)], 49
    for whorl, at in enumerate(range(4, 46, 3)):
        for k in range(5):
            turn = 2 * np.pi * k / 5 + 0.4 * whorl
            direction = np.array([np.cos(turn), np.sin(turn), 0.5]) / np.sqrt(1.25)
            nodes.append(stem[at] + np.linspace(0.01, 0.1, 8)[:, None] * direction)
            parent.append(np.concatenate([[at], count + np.arange(7)]))
            radius.append(np.linspace(0.0022, 0.0008, 8))
            count += 8
    skeleton = Skeleton.from_edges(np.vstack(nodes), np.concatenate(parent), np.concatenate(radius))
    meshed = mesh_branch(skeleton, MeshSettings(mesher="sweep"))
    assert skeleton.branch_count == 71 and not meshed.left_out
    assert dihedral_angles(meshed.mesh).min() > 2


@pytest.mark.slow
def test_tetwild_fills_a_branch_and_is_cached(y_skeleton, tmp_path, monkeypatch):
    """fTetWild keeps the volume, comes out oriented, and the second time from the cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    surface = branch_surface(y_skeleton, sides=6, spacing=4)
    # It inserts triangles in an order from the machine's entropy: 25 meshes have .992 to .999.
    mesh, cached = tetrahedralise(surface, edge_length=0.06, epsilon=0.001, time_limit=120)
    assert not cached and mesh.volumes.min() > 0
    assert mesh.volumes.sum() == pytest.approx(surface.volume, rel=0.03)
    again, cached = tetrahedralise(surface, edge_length=0.06, epsilon=0.001, time_limit=120)
    assert cached
    np.testing.assert_array_equal(mesh.nodes, again.nodes)


def test_tetwild_time_limit_hands_over_to_the_sweep(y_skeleton, tmp_path, monkeypatch):
    """Out of time, fTetWild is stopped; asked for it, the sweep takes over and says so."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(tetrahedra, "_SECONDS", 0.05)
    meshed = mesh_branch(y_skeleton, MeshSettings(mesher="ftetwild"))
    assert meshed.mesher == "sweep"
    assert "stopped" in meshed.warnings[0] and "sweep mesher was used instead" in meshed.warnings[0]


def test_wedges_split_alike_on_shared_faces():
    """Prisms side by side and on top of each other share whole triangles."""
    mesh = straight_beam(0.2, 0.01, quadratic=False)
    faces = mesh.surface_faces()
    check = check_surface(Surface(mesh.nodes, faces))
    assert check.watertight and check.oriented
    assert split_wedges(np.array([[0, 1, 2, 3, 4, 5]])).shape == (3, 4)


def test_beam_has_the_circles_area_and_inertia():
    """The hexagon has the circle's area, and its second moment within a percent."""
    mesh = straight_beam(0.3, 0.01, quadratic=False)
    assert mesh.volumes.sum() == pytest.approx(np.pi * 0.01**2 * 0.3, rel=1e-9)
    radius = 0.01 * polygon_factor(6)
    hexagon = 5 * np.sqrt(3) / 16 * radius**4
    assert hexagon == pytest.approx(np.pi * 0.01**4 / 4, rel=0.01)


def test_curved_beam_keeps_its_volume():
    """A quarter circle of a tapered beam: length times mean area."""
    angle = np.linspace(0, np.pi / 2, 60)
    points = 0.3 * np.column_stack([1 - np.cos(angle), np.zeros(60), np.sin(angle)])
    radius = np.linspace(0.01, 0.006, 60)
    mesh = curved_beam(points, radius)
    volume = 0.3 * np.pi / 2 * np.pi * (0.01**2 + 0.01 * 0.006 + 0.006**2) / 3
    assert mesh.volumes.sum() == pytest.approx(volume, rel=0.01)


def test_marks(forked_branch):
    """The base lies at the root, control points on the axis, the grasp at its fraction."""
    skeleton = forked_branch.skeleton
    mesh = mark(mesh_branch(skeleton).mesh, skeleton, young=1e8, poisson=0.35, density=900)
    fixed = mesh.nodes[mesh.point_data["fixed"] == 1]
    assert len(fixed) >= 7 and fixed[:, 2].max() < 0.003
    for k, fraction in enumerate((0.2, 0.4, 0.6, 0.8)):
        node = mesh.nodes[mesh.point_data["control_point"] == k]
        assert len(node) == 1
        assert np.linalg.norm(node[0] - skeleton.point_at(fraction)) < 0.02
    grasp = mesh.nodes[mesh.point_data["grasp"] == 1]
    assert len(grasp) >= 6
    assert np.linalg.norm(grasp.mean(axis=0) - skeleton.point_at(2 / 3)) < 0.02


def test_quality_of_a_regular_tetrahedron():
    """Radius ratio 1, dihedral angles of 70.5 degrees."""
    nodes = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    mesh = TetMesh(nodes, np.array([[0, 1, 2, 3]])).oriented()
    assert radius_ratios(mesh)[0] == pytest.approx(1)
    np.testing.assert_allclose(dihedral_angles(mesh), np.rad2deg(np.arccos(1 / 3)))


# The clamp is the face at the base; a tapered straight axis is meshed.


def rod(radius):
    return grown((-1, (0, 0, 0), (0, 0, 0.3), 31, radius))


@pytest.mark.parametrize("slice_length", [0.1, 0.5, 2.0])
def test_only_the_face_is_held_however_fine_the_mesh(slice_length):
    """A band above the face would hold the more of the branch the finer its mesh is."""
    radius = 0.01
    mesh = straight_beam(0.1, radius, slice_count=round(0.1 / (slice_length * radius)))
    held = base_nodes(mesh, rod((radius, radius))).astype(bool)
    on_face = mesh.nodes[:, 2] < 1e-9
    assert np.array_equal(held, on_face) and on_face.sum() >= 6


@pytest.mark.parametrize("tip", [0.004, 0.001, 0.0003])
def test_a_straight_tapered_axis_is_meshed(tip):
    mesh = sweep_tree(rod((0.012, tip))).mesh
    volume = np.pi * 0.3 * (0.012**2 + 0.012 * tip + tip**2) / 3
    assert mesh.volumes.min() > 0
    assert mesh.volumes.sum() == pytest.approx(volume, rel=0.08)
    meshed = mesh_branch(rod((0.012, tip)), MeshSettings(mesher="sweep"))
    assert meshed.mesh.tet_count > 50


def test_a_node_on_the_root_leaves_the_direction_of_the_base():
    """A fit to few points put one there: the base had no direction, and no nodes."""
    skeleton = rod((0.01, 0.01))
    nodes = skeleton.nodes.copy()
    nodes[1] = nodes[0]
    mesh = straight_beam(0.3, 0.01, slice_count=40)
    held = base_nodes(mesh, replace(skeleton, nodes=nodes))
    assert np.array_equal(held, base_nodes(mesh, skeleton)) and held.sum() >= 6
