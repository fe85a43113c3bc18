"""What a scene shows, worked out by the core: the order of vertices, averages, scales, refusals."""

import json
import struct

import numpy as np
import pytest

from limber.alignment import Alignment
from limber.errors import BranchFolderError, InputError
from limber.geometry.tets.cylinder_mesh import straight_beam
from limber.scene.data import at_nodes, scene_data
from limber.store import Branch


@pytest.fixture()
def mesh():
    return straight_beam(0.5, 0.01, slice_count=6, grasp_fraction=0.67)


def _branch(folder, mesh, **files):
    branch = Branch.create(folder)
    with branch.stage("reconstruct") as stage:
        mesh.write(stage.path("mesh.vtu"))
    for key, contents in files.items():
        with branch.stage(key.replace("__", ":")) as stage:
            for name, content in contents.items():
                stage.path(name).write_bytes(
                    content if isinstance(content, bytes) else content.encode())
    return Branch.open(folder)


def _pc2(frames):
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, frames.shape[1], 0.0, 1.0, len(frames))
    return head + frames.astype("<f4").tobytes()


def _plan(goal, points):
    rows = "\n".join(",".join(map(str, point)) for point in points)
    return {"plans/p.json": json.dumps({"goal": goal}), "plans/p.csv": f"x_m,y_m,z_m\n{rows}\n"}


def test_vertices_are_in_the_order_of_the_frames(tmp_path, mesh):
    """Vertices are the mesh's surface nodes in ascending order; faces index them, outward."""
    data = scene_data(_branch(tmp_path / "a.branch", mesh))
    vertices, faces = data.arrays["vertices"], data.arrays["faces"]
    np.testing.assert_array_equal(vertices, mesh.nodes[np.unique(mesh.surface_faces())])
    np.testing.assert_array_equal(vertices[faces], mesh.nodes[mesh.surface_faces()])
    corner = vertices[faces]
    volume = np.einsum("ij,ij->i", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum() / 6
    assert volume == pytest.approx(mesh.linear().volumes.sum(), rel=1e-9)


def test_alignment_takes_the_scan_to_the_branch(tmp_path, mesh):
    """The matrix does what the folder's alignment does."""
    branch = Branch.create(tmp_path / "a.branch")
    turn = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    with branch.stage("reconstruct") as stage:
        mesh.write(stage.path("mesh.vtu"))
        stage.manifest.alignment = Alignment(scale=0.001, origin=(1.0, 2.0, 3.0), rotation=turn)
    matrix = scene_data(branch).info["alignment"]
    points = np.random.default_rng(2).random((5, 3)) * 4000
    moved = np.column_stack([points, np.ones(5)]) @ matrix.T
    np.testing.assert_allclose(moved[:, :3], branch.manifest.alignment.apply(points), atol=1e-9)


def test_values_at_nodes_keep_constants_and_integrals(mesh):
    """A constant stays itself; a value in one tetrahedron reaches its own nodes alone."""
    np.testing.assert_allclose(at_nodes(mesh, np.full(mesh.tet_count, 3.5)), 3.5)
    one = np.zeros(mesh.tet_count)
    one[0] = 1.0
    found = at_nodes(mesh, one)
    assert set(np.flatnonzero(found)) == set(mesh.tets[0])


@pytest.mark.parametrize(("low", "high", "log", "ticks"), [
    (1e7, 3e7, False, ["10 MPa", "20 MPa", "30 MPa"]),
    (1e6, 1e8, True, ["1 MPa", "10 MPa", "100 MPa"]),
    (1e8, 1e8, False, ["50 MPa", "100 MPa", "150 MPa"]),
    (1e2, 1e8, True, ["100 kPa", "3.16 MPa", "100 MPa"]),
])
def test_scale(tmp_path, mesh, low, high, log, ticks):
    """The scale spans the values, goes by logarithm over a decade, and names its units."""
    young = np.full(mesh.tet_count, float(low))
    young[mesh.centroids[:, 2] > 0.25] = high
    data = scene_data(_branch(tmp_path / "a.branch", mesh.with_data(cell_data={"young": young})))
    scale = data.info["scalars"]["young"]
    assert scale["log"] is log
    assert scale["ticks"] == ticks
    colours = data.arrays["color:young"]
    assert colours.shape == (len(data.arrays["vertices"]), 4)
    assert ((colours >= 0) & (colours <= 1)).all()


def test_goal_path_and_motion(tmp_path, mesh):
    """Goal and path are those of the plan; the grasp's motion has one point a frame."""
    surface = mesh.nodes[np.unique(mesh.surface_faces())]
    points = [[0.0, 0.0, 0.3], [0.1, 0.0, 0.3], [0.1, 0.3, 0.3]]
    goal = {"kind": "tip", "position_m": [0.1, 0.3, 0.5], "tolerance_m": 0.01}
    frames = np.repeat(surface[None], 5, axis=0)
    branch = _branch(tmp_path / "a.branch", mesh,
                     plan__p=_plan(goal, points) | {"frames/p.pc2": _pc2(frames)})
    data = scene_data(branch)
    assert data.info["goal"] == {"kind": "tip", "centre_m": [0.1, 0.3, 0.5], "radius_m": 0.01}
    np.testing.assert_allclose(data.arrays["path:plan"], points)
    np.testing.assert_allclose(data.arrays["grasp_motion"][[0, 1, 4]],
                               [[0, 0, 0.3], [0.1, 0, 0.3], [0.1, 0.3, 0.3]])
    assert data.info["frames"]["count"] == 5
    assert data.info["size_m"] == pytest.approx(0.51, abs=0.02)
    assert np.linalg.norm(data.arrays["view_direction"]) == pytest.approx(1.0)


def test_frames_of_another_mesh_are_refused(tmp_path, mesh):
    """Too few vertices, a file cut short: an error, since Blender would show the rest shape."""
    surface = mesh.nodes[np.unique(mesh.surface_faces())]
    plan = _plan({}, [[0.0, 0.0, 0.3]])
    for name, content, words in (("fewer", _pc2(surface[None, 1:]), "another mesh"),
                                 ("cut", _pc2(surface[None])[:-4], "not a whole PC2"),
                                 ("none", b"", "not a whole PC2")):
        branch = _branch(tmp_path / name, mesh, plan__p=plan | {"frames/p.pc2": content})
        with pytest.raises(InputError, match=words):
            scene_data(branch)


def test_a_path_without_numbers_is_refused(tmp_path, mesh):
    """A damaged table is named; a NaN is not handed on."""
    for name, text in (("words", "x_m,y_m,z_m\n1,2,three\n"), ("nan", "x_m,y_m,z_m\n1,2,nan\n"),
                       ("empty", "x_m,y_m,z_m\n"), ("columns", "x,y\n1,2\n")):
        files = {"plans/p.json": "{}", "plans/p.csv": text}
        with pytest.raises(BranchFolderError, match=r"p\.csv"):
            scene_data(_branch(tmp_path / name, mesh, plan__p=files))


def test_the_file_reads_without_pickle(tmp_path, mesh):
    """The .npz holds plain arrays and JSON text."""
    scene_data(_branch(tmp_path / "a.branch", mesh)).write(tmp_path / "data.npz")
    with np.load(tmp_path / "data.npz", allow_pickle=False) as content:
        info = json.loads(str(content["info"]))
        assert {"vertices", "faces", "view_points"} <= set(content.files)
    assert info["format"] == 1
    assert info["unit"] == "m"
