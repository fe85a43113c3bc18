"""What a scene shows, worked out by the core: the order of vertices, averages, scales, refusals."""

import ast
import io
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest

from limber.cell.known_arms import arm_named
from limber.core.alignment import Alignment
from limber.core.constants import PATH_COLOURS
from limber.core.errors import BranchFolderError, InputError
from limber.core.numerics.rigid import matrices, pose_vectors
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.io.skeletons import write_cylinders
from limber.geometry.skeleton.skeleton import LIMITED, UNRESOLVED, Skeleton
from limber.geometry.tets.tree_sweep import straight_beam
from limber.results.motion_files import node_average
from limber.results.report import plan_figures
from limber.results.scene.animation import FIRST, SECOND, scene_data
from limber.results.scene.colours import balls, linear_of, rods
from limber.stages.results.scene import MakeScene
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
    np.testing.assert_allclose(node_average(mesh) @ np.full(mesh.tet_count, 3.5), 3.5)
    one = np.zeros(mesh.tet_count)
    one[0] = 1.0
    found = node_average(mesh) @ one
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
    assert scale["log"] is log and scale["is_one"] is (low == high)
    assert scale["ticks"] == ticks
    colours = data.arrays["color:young"]
    assert colours.shape == (len(data.arrays["vertices"]), 4)
    assert ((colours >= 0) & (colours <= 1)).all()


def test_a_goal_larger_than_the_branch_is_shown_as_it_is(tmp_path, mesh):
    """As a second arm's reach: a small ball where the path ends would be another goal."""
    goal = {"kind": "tip", "position_m": [0.6, 0.0, 0.5], "tolerance_m": 0.3}
    end = {"target_end_m": [0.36, 0.01, 0.41]}
    plan = {"plans/p.json": json.dumps({"goal": goal} | end),
            "plans/p.csv": "x_m,y_m,z_m\n0,0,0.3\n0.1,0,0.3\n"}
    data = scene_data(_branch(tmp_path / "a.branch", mesh, plan__p=plan))
    assert data.info["goal"] == {"kind": "tip", "centre_m": goal["position_m"], "radius_m": 0.3}


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


def test_paths_are_called_as_in_the_report(tmp_path, mesh):
    """Gentle and shortest, whichever planner found them; where both are one, that is said."""
    plan = _plan({}, [[0.0, 0.0, 0.3], [0.1, 0.0, 0.3]])
    leg = dict.fromkeys(("start_s", "length_m", "peak_speed_m_s", "peak_force_n",
                         "peak_torque_nm"), 0.0)
    summary = json.loads(plan["plans/p.json"]) | {"length_added_percent": 0.0, "legs": [
        leg | {"name": "path", "duration_s": 12.0}, leg | {"name": "hold", "duration_s": 2.0}]}
    plan |= {"plans/p-baseline.csv": plan["plans/p.csv"]}
    strength = {"median_strain": 0.006, "source": "green wood, assumed"}
    for saved, note in ((3.0, "energy -3 %, length +0 % against the shortest path"),
                        (0.0, "no shorter path was found")):
        told = json.dumps(summary | {"energy_saved_percent": saved, "strength": strength} | {
            key: {"length_m": 0.1, "peak_strain": strain}
            for key, strain in (("plan", 0.005), ("baseline", 0.007))})
        info = scene_data(_branch(tmp_path / str(saved), mesh,
                                  plan__p=plan | {"plans/p.json": told})).info
        assert {key: about["title"] for key, about in info["paths"].items()} == {
            "plan": "gentle", "baseline": "shortest"}
        assert note in info["notes"] and "motion: path 12 s, hold 2 s" in info["notes"]
        assert ("strain, shortest: over the 0.6 % at which half of such branches break (green "
                "wood, assumed)") in info["notes"]


def test_search_trees(tmp_path, mesh):
    """Nodes and parents of each planner's tree; a plan without them has none, a circle is named."""
    table = "planner,x_m,y_m,z_m,parent\nRRT*,0,0,0.3,-1\nRRT*,0.1,0,0.3,0\nRRT*,0,0.1,0.3,{}\n"
    plan = _plan({}, [[0.0, 0.0, 0.3], [0.1, 0.0, 0.3]])
    data = scene_data(_branch(tmp_path / "a", mesh, plan__p=plan | {
        "plans/p-trees.csv": table.format(1)}))
    np.testing.assert_allclose(data.arrays["tree:baseline"][2], [0, 0.1, 0.3])
    np.testing.assert_array_equal(data.arrays["tree_parent:baseline"], [-1, 0, 1])
    assert data.info["trees"] == {"baseline": {"title": "RRT*", "node_count": 3}}
    assert scene_data(_branch(tmp_path / "b", mesh, plan__p=plan)).info["trees"] == {}
    with pytest.raises(BranchFolderError, match=r"not contain search trees .* not form a tree"):
        scene_data(_branch(tmp_path / "c", mesh, plan__p=plan | {
            "plans/p-trees.csv": table.format(2)}))


def test_frames_of_another_mesh_are_refused(tmp_path, mesh):
    """Too few vertices, a file cut short or beyond single precision: an error, since Blender would
    show the rest shape.
    """
    surface = mesh.nodes[np.unique(mesh.surface_faces())]
    plan = _plan({}, [[0.0, 0.0, 0.3]])
    for name, content, words in (("fewer", _pc2(surface[None, 1:]), "another mesh"),
                                 ("cut", _pc2(surface[None])[:-4], "not a complete PC2"),
                                 ("far", _pc2(1e25 * surface[None]), "beyond 1e[+]18"),
                                 ("none", b"", "not a complete PC2")):
        branch = _branch(tmp_path / name, mesh, plan__p=plan | {"frames/p.pc2": content})
        with pytest.raises(InputError, match=words):
            scene_data(branch)


def test_frames_of_an_earlier_mesh_are_left_out(tmp_path, mesh):
    """The mesh was made anew: the branch is shown without its old motion, and that is said."""
    surface = mesh.nodes[np.unique(mesh.surface_faces())]
    branch = _branch(tmp_path / "a", mesh)
    with branch.stage("plan:p", reads=["mesh.vtu"]) as stage:
        for name, text in _plan({}, [[0.0, 0.0, 0.3]]).items():
            stage.path(name).write_text(text)
        stage.path("frames/p.pc2").write_bytes(_pc2(surface[None, 1:]))
    branch.manifest.stages["plan:p"].finished = "2026-01-01T00:00:00+00:00"
    (branch.folder / "branch.json").write_text(branch.manifest.text())
    with branch.stage("reconstruct") as stage:
        mesh.with_data(cell_data={"young": np.full(mesh.tet_count, 2e8)}).write(
            stage.path("mesh.vtu"))
    data = scene_data(branch)
    assert "frames" not in data.info and "path:plan" in data.arrays
    assert any("p belongs to an earlier mesh" in note for note in data.info["notes"])
    with pytest.raises(InputError, match="another mesh"):
        scene_data(branch, motion="p")


def test_a_path_without_numbers_is_refused(tmp_path, mesh):
    """A damaged table is named; a NaN is not handed on."""
    for name, text in (("words", "x_m,y_m,z_m\n1,2,three\n"), ("nan", "x_m,y_m,z_m\n1,2,nan\n"),
                       ("empty", "x_m,y_m,z_m\n"), ("columns", "x,y\n1,2\n")):
        files = {"plans/p.json": "{}", "plans/p.csv": text}
        with pytest.raises(InputError, match=r"p\.csv"):
            scene_data(_branch(tmp_path / name, mesh, plan__p=files))


def test_the_file_reads_without_pickle(tmp_path, mesh):
    """The .npz holds plain arrays and JSON text."""
    scene_data(_branch(tmp_path / "a.branch", mesh)).write(tmp_path / "data.npz")
    with np.load(tmp_path / "data.npz", allow_pickle=False) as content:
        info = json.loads(str(content["info"]))
        assert {"vertices", "faces", "view_points"} <= set(content.files)
    assert info["format"] == 2
    assert info["unit"] == "m"


def _bending(surface, count):
    """Frames that bend towards x by the square of the height, more with each."""
    frames = np.repeat(surface[None], count, axis=0)
    frames[:, :, 0] += np.linspace(0, 1, count)[:, None] * surface[:, 2] ** 2
    return frames


def test_a_simulation_has_its_own_times_and_moves_its_marks(tmp_path, mesh):
    """Frames of a simulation: rate, times, fields of each frame, grasp and control points along."""
    surface = mesh.nodes[np.unique(mesh.surface_faces())]
    marks = np.full(mesh.node_count, -1)
    marks[np.abs(mesh.nodes - [0, 0, 0.25]).sum(axis=1).argmin()] = 0
    mesh = mesh.with_data(point_data={"control_point": marks})
    frames = _bending(surface, 4)
    fields = np.arange(4.0)[:, None] * np.ones(len(surface))
    npz = io.BytesIO()
    np.savez(npz, strain_energy_density_j_m3=fields, principal_strain=0.01 * fields,
             det_f=1 - 0.01 * fields, principal_stress_pa=fields[:2])
    about = {"rate": 60.0, "times_s": [0, 1 / 60, 2 / 60, 3 / 60], "energies_j": [0, 1, 2, 3],
             "min_det_f": [1, 0.9, 0.8, 0.7]}
    branch = _branch(tmp_path / "a.branch", mesh, simulate={
        "frames/s.pc2": _pc2(frames), "frames/s.json": json.dumps(about),
        "frames/s.npz": npz.getvalue()})
    data = scene_data(branch)
    about = data.info["frames"]
    assert (about["name"], about["rate_hz"], about["is_timed"]) == ("s", 60.0, True)
    np.testing.assert_allclose(data.arrays["frame_times"], np.arange(4) / 60)
    np.testing.assert_allclose(data.arrays["frame_min_det_f"], [1, 0.9, 0.8, 0.7])
    # Of the stress there are fewer frames than of the motion: it is left out.
    assert set(data.info["frame_scalars"]) == {"strain_energy", "strain", "det_f"}
    np.testing.assert_allclose(data.arrays["frame_scalar:strain"], 0.01 * fields)
    np.testing.assert_allclose(data.arrays["scalar:det_f"], 0.97, rtol=1e-6)
    assert data.info["scalars"]["strain"]["ticks"][2] in {"3 %", "4.5 %"}
    for name, height in (("grasp", 0.5 * 0.67), ("control_points", 0.25)):
        moved = data.arrays[f"{name}_motion"].reshape(4, 3)
        np.testing.assert_allclose(moved[0], data.arrays[name][0], atol=1e-6)
        assert moved[-1, 0] - moved[0, 0] == pytest.approx(height**2, rel=0.15)


def test_stress_over_strength(tmp_path, mesh):
    """Over 0.6 % of E where no strength is known, and that is said; one colour, one number."""
    surface = mesh.nodes[np.unique(mesh.surface_faces())]
    mesh = mesh.with_data(cell_data={"young": np.full(mesh.tet_count, 5e9)})
    stress = np.linspace(0, 45e6, 3)[:, None] * np.ones(len(surface))
    npz = io.BytesIO()
    np.savez(npz, principal_stress_pa=stress)
    branch = _branch(tmp_path / "a.branch", mesh, simulate={
        "frames/s.pc2": _pc2(_bending(surface, 3)), "frames/s.npz": npz.getvalue()})
    data = scene_data(branch)
    np.testing.assert_allclose(data.arrays["frame_scalar:stress_over_strength"][:, 0],
                               [0.0, 0.75, 1.5], rtol=1e-6)
    assert "0.6 % of E, assumed" in data.info["frame_scalars"]["stress_over_strength"]["title"]
    known = scene_data(branch, strength=90e6)
    np.testing.assert_allclose(known.arrays["scalar:stress_over_strength"], 0.5)
    assert "(90 MPa)" in known.info["scalars"]["stress_over_strength"]["title"]
    levels = data.arrays["frame_level:stress_over_strength"]
    np.testing.assert_array_equal(levels[:, 0], [0, 128, 255])
    colours = data.arrays["palette:inferno"][levels[-1]]
    np.testing.assert_allclose(colours, data.arrays["color:stress_over_strength"], atol=1e-6)


def test_rods_lie_about_their_lines(mesh):
    """Each vertex at the radius of its point, across the line; lines without length have none."""
    points = np.array([[0, 0, 0], [0, 0, 1.0], [1.0, 0, 1.0]])
    vertices, faces, node = rods(points, np.array([[0, 1], [1, 2], [1, 1]]),
                                 np.array([0.1, 0.1, 0.2]))
    assert set(faces.ravel()) == set(range(len(vertices))) and len(vertices) == len(node) == 24
    away = np.linalg.norm(vertices - points[node], axis=1)
    np.testing.assert_allclose(away, np.array([0.1, 0.1, 0.2])[node])
    np.testing.assert_allclose(vertices[:12, 2], points[node[:12], 2], atol=1e-12)


def test_balls_lie_about_their_points():
    """Twelve vertices a point, all at the radius; their triangles look outwards."""
    points = np.array([[0, 0, 0], [5.0, 0, 1.0]])
    vertices, faces, node = balls(points, 0.1)
    assert len(vertices) == 24 and len(faces) == 40
    away = vertices - points[node]
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.1)
    corner = away[faces]
    outwards = np.einsum("ij,ij->i", np.cross(corner[:, 1] - corner[:, 0],
                                              corner[:, 2] - corner[:, 0]), corner[:, 0])
    assert (outwards > 0).all()


def test_graphs_of_an_estimate(tmp_path, mesh):
    """E with its interval and the truth, force measured and simulated, distances to the measured.

    Places are shares of the frame: 10 and 40 MPa stand where the ticks of that name stand."""
    estimate = {
        "method": "gauss-newton", "young_pa": [4e7, 1e7], "poisson": 0.35, "loss_m2": 1e-6,
        "young_interval_pa": [[3e7, 5e7], [8e6, 1.2e7]], "forward_count": 3, "converged": True,
        "control_points_m": [[0, 0, 0.2], [0, 0, 0.4]], "fractions": [0.4, 0.8],
        "parameters": ["E1", "E2"], "groups": [0, 1], "covariance": [[1, 0], [0, 1]],
        "deviations_before_fit": [1, 1], "history": [], "pulls": [{
            "name": "p", "times_s": [0, 1], "all_times_s": [0, 1],
            "observed_m": [[[0, 0, 0.2], [0, 0, 0.4]], [[0.01, 0, 0.2], [None, None, None]]],
            "simulated_m": [[[0, 0, 0.2], [0, 0, 0.4]], [[0.014, 0, 0.2], [0.05, 0, 0.4]]],
            "measured_force_n": [[0, 0, 0], [3, 4, 0]],
            "simulated_force_n": [[0, 0, 0], [6, 0, 0]]}]}
    marks = np.full(mesh.node_count, -1)
    for number, height in enumerate((0.2, 0.4)):
        marks[np.abs(mesh.nodes - [0, 0, height]).sum(axis=1).argmin()] = number
    data = scene_data(_branch(
        tmp_path / "a.branch", mesh.with_data(point_data={"control_point": marks}),
        estimate={"estimate.json": json.dumps(estimate)}))
    young, force = data.info["graphs"]["young"], data.info["graphs"]["force"]
    ticks = {words: share for share, words in young["y"]["ticks"]}
    (line,) = [line for line in young["lines"] if line["label"] == "estimated"]
    assert line["points"][1] == pytest.approx([0.8, ticks["10 MPa"]], abs=1e-3)
    assert ticks["10 MPa"] < ticks["20 MPa"] < line["points"][0][1] < ticks["50 MPa"]
    assert young["bands"][0]["rows"][0][1] < line["points"][0][1] < young["bands"][0]["rows"][0][2]
    ends = {line["label"]: line["points"][-1] for line in force["lines"]}
    assert ends["measured"][1] == pytest.approx(5 / 6 * ends["simulated"][1], abs=1e-3)
    scale = data.info["rods"]["fit"]["scale"]
    assert (scale["low"], scale["high"]) == (0.0, pytest.approx(0.004))
    balls = data.arrays["rods:fit"][-12:]
    np.testing.assert_allclose(balls.mean(axis=0), [0.01, 0, 0.2], atol=1e-12)
    nearest = np.abs(data.arrays["vertices"] - [0, 0, 0.2]).sum(axis=1).argmin()
    assert data.arrays["scalar:residual"][nearest] == pytest.approx(0.004 / np.sqrt(2), rel=0.05)


def test_the_newest_motion_is_the_one_finished_last(tmp_path, mesh):
    """By the manifest, not by the files' own times, which a copy changes."""
    surface = mesh.nodes[np.unique(mesh.surface_faces())]
    branch = _branch(tmp_path / "a.branch", mesh,
                     simulate={"frames/b.pc2": _pc2(_bending(surface, 3))},
                     other={"frames/a.pc2": _pc2(_bending(surface, 2))})
    branch.manifest.stages["simulate"].finished = "2026-01-01T00:00:00+00:00"
    branch.manifest.stages["other"].finished = "2026-01-02T00:00:00+00:00"
    os.utime(branch.path("frames/a.pc2"), (1, 1))
    assert scene_data(branch).info["frames"]["name"] == "a"


def test_motions_are_named(tmp_path, mesh):
    """Of several motions the plan's is shown, or the one that is named; another name is refused."""
    surface = mesh.nodes[np.unique(mesh.surface_faces())]
    plan = _plan({}, [[0.0, 0.0, 0.3]]) | {"frames/p.pc2": _pc2(_bending(surface, 2))}
    branch = _branch(tmp_path / "a.branch", mesh, plan__p=plan,
                     simulate={"frames/s.pc2": _pc2(_bending(surface, 3))})
    assert scene_data(branch).info["frames"]["name"] == "p"
    assert scene_data(branch).info["motions"] == ["p", "s"]
    named = scene_data(branch, motion="s")
    assert named.info["frames"]["count"] == 3
    assert not named.info["frames"]["is_timed"]
    with pytest.raises(BranchFolderError, match="Its frames are: p, s"):
        scene_data(branch, motion="q")


def test_scan_skeleton_and_path_energy(tmp_path, mesh):
    """The cloud with linear colours, the centreline with radii and flags, energy along paths."""
    nodes = np.array([[0, 0, 0], [0, 0, 0.2], [0, 0, 0.5], [0.1, 0, 0.3]], float)
    skeleton = Skeleton.from_edges(nodes, np.array([-1, 0, 1, 1]), np.array([.01, .01, .005, .004]),
                                   radius_sigma=np.array([0, 1e-4, 2e-4, 3e-4]),
                                   radius_state=np.array([0, 0, LIMITED, UNRESOLVED]),
                                   probability=np.array([1, 1, 1, 0.4]))
    branch = Branch.create(tmp_path / "a.branch")
    points = np.random.default_rng(0).random((7, 3))
    colour = np.array([[255, 0, 0]] * 6 + [[188, 188, 188]])
    with branch.stage("reconstruct") as stage:
        mesh.write(stage.path("mesh.vtu"))
        Cloud(points, {"color": colour}).write_ply(stage.path("cloud.ply"))
        skeleton.write_swc(stage.path("skeleton.swc"))
        write_cylinders(skeleton, stage.path("skeleton.csv"))
    rows = ("s_m,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad,energy_j\n"
            "0,0,0,0.3,0,0,0,0\n1,0.1,0,0.3,0,1,0,0.5\n")
    with branch.stage("plan:p") as stage:
        stage.path("plans/p.json").write_text("{}")
        stage.path("plans/p.csv").write_text(rows)
    data = scene_data(Branch.open(tmp_path / "a.branch"))
    arrays = data.arrays
    np.testing.assert_allclose(arrays["cloud"], points, atol=1e-7)
    np.testing.assert_allclose(arrays["cloud_color"][[0, 6], 0], [1.0, 0.5029], atol=1e-3)
    np.testing.assert_allclose(arrays["skeleton"], skeleton.nodes)
    by_place = {tuple(np.round(node, 3)): number for number, node in enumerate(arrays["skeleton"])}
    fork, tip, root = by_place[0, 0, 0.2], by_place[0, 0, 0.5], by_place[0, 0, 0]
    flags = arrays["skeleton_flags"]
    assert (flags[root], flags[fork], flags[tip]) == (1, 2, 4 + 8)
    assert flags[by_place[0.1, 0, 0.3]] == 4 + 32
    np.testing.assert_allclose(sorted(arrays["skeleton_probability"]), [0.4, 1, 1, 1])
    assert arrays["skeleton_radius_sigma"][tip] == pytest.approx(2e-4)
    np.testing.assert_allclose(arrays["path_energy:plan"], [0, 0.5])
    np.testing.assert_allclose(arrays["path_pose:plan"][1], [0.1, 0, 0.3, 0, 1, 0])
    assert data.info["path_energy"]["high"] == 0.5
    assert arrays["path_color:plan"][1, 0] > arrays["path_color:plan"][0, 0]


def test_the_map_offset_is_kept_in_double_precision(tmp_path, mesh):
    """A scan in map coordinates: where the branch's origin is there, to the micrometre."""
    branch = Branch.create(tmp_path / "a.branch")
    with branch.stage("reconstruct") as stage:
        mesh.write(stage.path("mesh.vtu"))
        stage.manifest.alignment = Alignment(origin=(32612345.678901, 5812345.123456, 71.5))
    data = scene_data(branch)
    np.testing.assert_allclose(data.info["map_offset"], [32612345.678901, 5812345.123456, 71.5],
                               rtol=0, atol=1e-6)


def test_the_stage_shows_the_folders_targets(tmp_path, mesh):
    """What `limber target` wrote is in the file that the add-on opens."""
    targets = {"format_version": 1, "targets": [
        {"name": "flower", "position_m": [0.0, 0.0, 0.4], "mass_kg": 0.01}]}
    _branch(tmp_path / "a.branch", mesh.with_data(
        cell_data={"young": np.full(mesh.tet_count, 1e8)}),
            target={"targets.json": json.dumps(targets)})
    MakeScene(branch_folder=tmp_path / "a.branch", data=tmp_path / "data.npz").run()
    with np.load(tmp_path / "data.npz", allow_pickle=False) as content:
        assert json.loads(str(content["info"]))["targets"] == ["flower"]
        np.testing.assert_allclose(content["targets"], [[0.0, 0.0, 0.4]])
        assert content["targets_radius"].shape == (1,)


def _preview(joints, base, arm):
    """A dry run's table for these joints; its poses are those of the flange."""
    poses = pose_vectors(matrices(np.array(base)) @ arm.forward(joints))
    columns = ["t_s", "x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad",
               *(f"q{n}_rad" for n in range(1, 7)), "fx_n", "fy_n", "fz_n"]
    rows = np.column_stack([np.arange(len(poses)), poses, joints, np.zeros((len(poses), 3))])
    return poses, ",".join(columns) + "\n" + "\n".join(
        ",".join(f"{x:.9g}" for x in row) for row in rows) + "\n"


@pytest.mark.parametrize("away, model", [(0.0, "ur5e"), (0.1, "ur5e"), (0.0, "gone.urdf")])
def test_the_arm_of_the_dry_run_is_where_its_joints_say(tmp_path, mesh, away, model):
    """In each frame: foot and links as rods of the arm's own lengths, and the cell's gripper,
    which is in the picture; an arm that is elsewhere, or not known here, is not shown."""
    arm = arm_named("ur5e")
    steps = np.linspace(0, 1, 41)[:, None]
    joints = np.array([0.4, -1.2, 1.5, -0.3, 0.8, 0.2]) + steps * [0.3, 0.1, -0.2, 0.2, 0.1, 0.0]
    base = [0.5, -0.3, 0.1, 0.0, 0.0, 0.7]
    poses, table = _preview(joints, base, arm)
    taken = poses[::10]
    surface = mesh.nodes[np.unique(mesh.surface_faces())]
    points = taken[:, :3] + [away, 0, 0]
    branch = _branch(tmp_path / "a.branch", mesh, plan__p=_plan({}, points) | {
        "frames/p.pc2": _pc2(np.repeat(surface[None], len(points), axis=0))})
    with branch.stage("execute-preview:p", reads=["plans/p.csv"]) as stage:
        stage.path("executions/p-preview.csv").write_text(table)
        stage.result.update(model=model, base_pose=base, gripper_rods=[
            [0, 0, 0, 0, 0, 0.1, 0.04], [0, 0.02, 0.1, 0, 0.02, 0.15, 0.01],
            [0, -0.02, 0.1, 0, -0.02, 0.15, 0.01]])
    data = scene_data(Branch.open(tmp_path / "a.branch"))
    if away or model != "ur5e":
        assert "robot_starts" not in data.arrays
        return
    starts, ends = data.arrays["robot_starts"], data.arrays["robot_ends"]
    own = arm.rods(joints[::10])
    assert starts.shape == ends.shape == (5, len(own.radii) + 4, 3)
    assert data.info["robot"] == {"name": "ur5e", "gripper_rods": 3}
    np.testing.assert_allclose(starts[:, 0], np.repeat([base[:3]], 5, axis=0))
    lengths = np.linalg.norm(ends - starts, axis=2)[:, 1:-3]
    np.testing.assert_allclose(lengths, np.linalg.norm(own.ends - own.starts, axis=2), atol=1e-7)
    np.testing.assert_allclose(data.arrays["robot_radii"][1:-3], own.radii)
    fingers = 0.5 * (ends[:, -2] + ends[:, -1])
    flange = matrices(np.array(base)) @ arm.forward(joints[::10])
    np.testing.assert_allclose(fingers, (flange @ [0, 0, 0.15, 1])[:, :3], atol=1e-6)
    shown = data.arrays["view_points"]
    assert all((shown == end).all(axis=1).any() for end in ends[0, -3:])


def test_paths_have_the_same_colours_everywhere():
    """In report, scene and graphs the gentle path is red and the shortest one blue."""
    scene = Path(__file__).parents[3] / "addon" / "show" / "scene.py"
    tree = ast.parse(scene.read_text(encoding="utf-8"))
    colors = next(node.value for node in tree.body if isinstance(node, ast.Assign)
                  and getattr(node.targets[0], "id", "") == "COLORS")
    shown = dict(zip([key.value for key in colors.keys], colors.values, strict=True))
    for key, graph, reddest in (("plan", FIRST, True), ("baseline", SECOND, False)):
        srgb = np.array([int(PATH_COLOURS[key][i:i + 2], 16) for i in (1, 3, 5)]) / 255
        linear = ast.literal_eval(shown[f"path:{key}"])
        assert np.allclose(linear_of(srgb), linear, atol=0.01)
        for colour in (srgb, graph):
            assert (colour[0] > colour[2]) == reddest
    assert plan_figures.PATH_COLOURS is PATH_COLOURS


# What was measured in a pull over the motion that replays it: places, residual, force.

PULL = {
    "pulls/a/pull.toml": "observation = 'markers'\nrest_points_m = [[0.0, 0.0, 0.5], "
                         "[0.0, 0.0, 0.2]]\n[grasp]\npoint_m = [0.0, 0.0, 0.3]\n"
                         "radius_m = 0.01\n",
    # The robot's clock begins at 3 s.
    "pulls/a/robot.csv": "t_s,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad,fx_n,fy_n,fz_n,tx_nm,ty_nm,tz_nm\n"
                         "3,0,0,0.3,0,0,0,0,0,0,0,0,0\n4,0.1,0,0.3,0,0,0,0,3,4,0,0,0\n",
    "pulls/a/markers.csv": "t_s,m0_x_m,m0_y_m,m0_z_m,m1_x_m,m1_y_m,m1_z_m\n"
                           "3,0,0,0.5,0,0,0.2\n3.5,,,,0.02,0,0.2\n4,0.2,0,0.5,0.04,0,0.2\n"}


@pytest.fixture()
def branch(tmp_path):
    """A beam with a pull, and a motion of its name that goes 5 frames along x as one body."""
    mesh = straight_beam(0.5, 0.01, slice_count=6, grasp_fraction=0.67)
    surface = mesh.nodes[np.unique(mesh.surface_faces())]
    frames = np.repeat(surface[None], 5, axis=0)
    frames[:, :, 0] += np.linspace(0, 0.2, 5)[:, None]
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, len(surface), 0.0, 1.0, 5)
    branch = Branch.create(tmp_path / "a.branch")
    with branch.stage("reconstruct") as stage:
        mesh.write(stage.path("mesh.vtu"))
    with branch.stage("pull:a") as stage:
        for name, content in PULL.items():
            stage.path(name).write_text(content)
    with branch.stage("replay:a") as stage:
        stage.path("frames/a.pc2").write_bytes(head + frames.astype("<f4").tobytes())
        stage.path("frames/a.json").write_text(json.dumps(
            {"rate": 4.0, "times_s": [0, 0.25, 0.5, 0.75, 1.0]}))
    return Branch.open(branch.folder)


def test_what_was_measured_over_time(branch):
    """Observed points of a pull; one not seen stands where it was last and is flagged."""
    data = scene_data(branch)
    assert data.info["observation"] == {"pull": "a", "is_shown": True}
    np.testing.assert_allclose(data.arrays["observation"][:, 0, 0], [0, 0, 0.2])
    np.testing.assert_array_equal(data.arrays["observation_visible"][:, 0], [True, False, True])
    np.testing.assert_allclose(data.arrays["observation_grasp"][:, 0], [0, 0.1])


def test_each_frame_has_what_was_measured_then(branch):
    """On the frames' clock, not the robot's; between two looks on the line; unseen in between."""
    arrays = scene_data(branch).arrays
    np.testing.assert_allclose(arrays["observation_motion"][:, 0, 0], [0, 0.05, 0.1, 0.15, 0.2])
    np.testing.assert_allclose(arrays["observation_motion"][:, 1, 0], [0, 0.01, 0.02, 0.03, 0.04])
    assert not arrays["observation_seen"][2, 0] and arrays["observation_seen"][[0, 4], 0].all()
    assert arrays["observation_seen"][:, 1].all()


def test_the_residual_follows_the_frames(branch):
    """The beam goes 0.2 m, its lower mark was seen to go 0.04 m: 0.16 m off about it at the end,
    nothing at the start; near the upper mark, which was met, far less."""
    data = scene_data(branch)
    residual, vertices = data.arrays["frame_scalar:residual"], data.arrays["vertices"]
    assert residual.shape == (5, len(vertices))
    assert residual[0].max() < 1e-6
    low = np.linalg.norm(vertices - [0, 0, 0.2], axis=1).argmin()
    top = np.linalg.norm(vertices - [0, 0, 0.5], axis=1).argmin()
    assert residual[-1, low] == pytest.approx(0.16, rel=0.03)
    assert residual[-1, top] < 0.01
    # The upper mark is not seen in the middle: the lower one alone counts there.
    np.testing.assert_allclose(residual[2], 0.08, rtol=1e-5)
    assert "pull a" in data.info["frame_scalars"]["residual"]["title"]
    np.testing.assert_allclose(data.arrays["scalar:residual"], residual.max(axis=0), rtol=1e-6)


def test_the_force_over_time_has_a_cursor_at_each_frame(branch):
    """Measured 0 and 5 N at 3 and 4 s; the cursor goes from the one to the other."""
    graph = scene_data(branch).info["graphs"]["force"]
    assert [line["label"] for line in graph["lines"]] == ["measured"]
    places = graph["lines"][0]["points"]
    assert places[1][1] / 5.0 == pytest.approx(1 / 5.3, rel=0.01)
    np.testing.assert_allclose([graph["cursor"][0], graph["cursor"][-1]],
                               [places[0][0], places[1][0]], atol=1e-4)


def test_another_motion_is_not_compared(branch):
    """Frames of something else: the measurement is there, but in no frame, and has no residual."""
    with branch.stage("simulate") as stage:
        for ending in ("pc2", "json"):
            stage.path(f"frames/s.{ending}").write_bytes(
                branch.path(f"frames/a.{ending}").read_bytes())
    data = scene_data(branch, motion="s")
    assert data.info["observation"] == {"pull": "a", "is_shown": False}
    assert "observation" in data.arrays and "observation_motion" not in data.arrays
    assert "residual" not in data.info["scalars"]
    assert data.info["graphs"]["force"]["cursor"] == []
