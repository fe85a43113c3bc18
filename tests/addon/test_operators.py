"""What a user's actions do, from the bpy package: errors are clear, results are right."""

import shutil
import struct
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tests.addon.conftest import part

from limber.core.files.atomic import file_digest
from limber.geometry.cloud.preparation import LONGEST
from limber.geometry.io.clouds import read_cloud
from limber.store import Branch

POINTS = np.random.default_rng(7).random((40, 3)) * 300


def _ply(path, kind):
    order = {"<": "binary_little_endian", ">": "binary_big_endian"}[kind]
    head = (f"ply\nformat {order} 1.0\ncomment made here\nelement vertex {len(POINTS)}\n"
            "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
            "end_header\n")
    body = b"".join(struct.pack(f"{kind}fffB", *point, 7) for point in POINTS)
    path.write_bytes(head.encode() + body)


def _text(path, delimiter, header):
    lines = [header] if header else []
    lines += [delimiter.join(f"{value:.9g}" for value in (*point, 9.0)) for point in POINTS]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(("name", "write"), [
    ("b.ply", lambda path: _ply(path, "<")),
    ("c.ply", lambda path: _ply(path, ">")),
    ("d.xyz", lambda path: _text(path, " ", "")),
    ("e.csv", lambda path: _text(path, ",", "x,y,z,intensity")),
    ("f.txt", lambda path: _text(path, ";", "")),
])
def test_import_cloud(bpy, registered, tmp_path, name, write):
    """Every kind of file shows its points, in metres, and proposes a branch folder beside it."""
    meshes = part("bridge.meshes")
    write(tmp_path / name)
    settings = bpy.context.scene.limber
    settings.reconstruct.unit = "mm"
    assert bpy.ops.limber.import_cloud(filepath=str(tmp_path / name)) == {"FINISHED"}
    cloud = bpy.data.objects[f"{name[0]} scan"]
    np.testing.assert_allclose(meshes.positions(cloud.data), POINTS, rtol=1e-5)
    assert list(cloud.scale) == pytest.approx([0.001] * 3)
    assert settings.branch_folder == str(tmp_path / f"{name[0]}.branch")


@pytest.mark.parametrize("text", [
    "id,x,y,z\n0,0.1,0.2,0.3\n7000,0.4,0.5,0.6\n",
    "z,x,y,r,g,b\n0.3,0.1,0.2,110,118,156\n0.6,0.4,0.5,60,107,92\n",
    '"","x","y","z"\n"1",0.1,0.2,0.3\n"2",0.4,0.5,0.6\n',
    "\ufeffX [m];Y [m];Z [m];Note\n0,1;0,2;0,3;7\n0,4;0,5;0,6;8\n",
    "//Height Easting Northing\n0.3 0.1 0.2\n0.6 0.4 0.5\n",
    "# id x y z\n0.1 0.2 0.3 9\n0.4 0.5 0.6 9\n",
    "2\n0.1\t0.2\t0.3\n0.4\t0.5\t0.6\n",
    "0,1 0,2 0,3\n0,4 0,5 0,6\n",
    "0.1,0.2,0.3,\n0.4,0.5,0.6,\n"])
def test_columns_are_read_as_the_worker_reads_them(bpy, registered, tmp_path, text):
    """Coordinates by the header's names, in whatever order; no other column, no unit guessed."""
    path = tmp_path / "scan.csv"
    path.write_text(text, encoding="utf-8")
    points, *_ = part("scan.clouds").read_points(path)
    np.testing.assert_allclose(points, [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    np.testing.assert_allclose(points, read_cloud(path).points)
    bpy.ops.limber.import_cloud(filepath=str(path))
    assert bpy.context.scene.limber.reconstruct.unit == "m"


@pytest.mark.parametrize(("name", "text", "unit"), [
    ("a.csv", "x_mm,y_mm,z_mm\n100,200,300\n400,500,600\n", "mm"),
    ("a.ply", "ply\nformat ascii 1.0\ncomment unit: mm\nelement vertex 2\nproperty float z\n"
              "property float x\nproperty float y\nend_header\n300 100 200\n600 400 500\n", "mm"),
    ("a.asc", "//X Y Z R G B\n2\n.1 .2 .3 9 8 7\n.4 .5 .6 9 8 7\n", "m")])
def test_the_units_and_files_of_other_programs(bpy, registered, tmp_path, name, text, unit):
    """A unit that the file states is set, and the points are the worker's."""
    path = tmp_path / name
    path.write_text(text)
    points, *_ = part("scan.clouds").read_points(path)
    np.testing.assert_allclose(points * {"m": 1.0, "mm": 1e-3}[unit], read_cloud(path).points)
    bpy.ops.limber.import_cloud(filepath=str(path))
    assert bpy.context.scene.limber.reconstruct.unit == unit


@pytest.mark.parametrize("name", ["realsense_ascii_normals.ply", "metashape.txt", "polycam.ply"])
def test_a_scan_has_the_workers_colours(bpy, registered, name):
    path = Path(__file__).parents[1] / "data" / "tour" / name
    points, _, colours = part("scan.clouds").read_points(path)
    read = read_cloud(path)
    np.testing.assert_allclose(points, read.points, atol=1e-9)
    np.testing.assert_array_equal(colours, read.attributes["color"])
    bpy.ops.limber.import_cloud(filepath=str(path))
    assert bpy.data.objects[f"{path.stem} scan"].data.color_attributes
    with pytest.raises(RuntimeError, match="No file was chosen"):
        bpy.ops.limber.import_cloud(filepath="")


@pytest.mark.parametrize(("content", "why"), [
    (b"", ""), (b"ply\nformat ascii 1.0\n", ""), (b"1 2 nan\n", ""), (b"a b c\nd e f\n", ""),
    (b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\n"
     b"property float y\nproperty float z\nend_header\nxx", ""),
    # No memory is taken for what a header only claims.
    (b"ply\nformat binary_little_endian 1.0\nelement vertex 900000000000\n"
     b"property float x\nproperty float y\nproperty float z\nend_header\n1234", ""),
    # COLMAP's points have a track behind them, and their number first: no x.
    (b"# POINT3D_ID, X, Y, Z, TRACK[]\n7 0.1 0.2 0.3 1 5\n900 0.4 0.5 0.6 1\n",
     "line 3 has 5 values, but the first line has 6"),
    (b"id,row,column\n0,1,2\n1,2,3\n", r"has the columns id, row, column\. x, y and z")])
def test_bad_clouds_are_refused(bpy, registered, tmp_path, content, why):
    """An empty, truncated or foreign file is an error that names it; nothing is added, and no
    other column is taken for a coordinate."""
    for name in ("bad.ply", "bad.xyz"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(RuntimeError, match=f"{name}.*{why if name == 'bad.xyz' else ''}"):
            bpy.ops.limber.import_cloud(filepath=str(tmp_path / name))
    assert not bpy.data.objects


def test_reconstruct_wants_a_scan(bpy, registered):
    """Without a scan no worker is started; the message says what to choose."""
    with pytest.raises(RuntimeError, match="Choose a scan first"):
        bpy.ops.limber.reconstruct()


def test_reconstruct_hands_the_worker_what_the_user_chose(bpy, registered, tmp_path, monkeypatch):
    """The worker gets file, folder and unit; its error reaches the user as it is."""
    jobs = part("jobs.jobs")
    seen = []
    start = jobs.start
    monkeypatch.setattr(jobs, "start", lambda title, command, _: seen.append(command) or start(
        title, [command[0], "-c", "print('{\"status\": \"failed\", \"error\": \"Too few.\"}');"
                                  "raise SystemExit(2)"]))
    (tmp_path / "scan.xyz").write_text("0 0 0\n")
    settings = bpy.context.scene.limber
    settings.reconstruct.cloud, settings.reconstruct.unit = str(tmp_path / "scan.xyz"), "mm"
    with pytest.raises(RuntimeError, match="Too few"):
        bpy.ops.limber.reconstruct()
    assert seen[0][1:] == ["-m", "limber", "reconstruct", "--json", "--progress", "json",
                           "--output", str(tmp_path / "scan.branch"), "--unit", "mm", "--",
                           str(tmp_path / "scan.xyz")]


@pytest.mark.slow
def test_open_result_and_play(bpy, registered, beam):
    """A branch folder is opened through the worker; play starts at the first frame."""
    assert bpy.ops.limber.open_result(directory=str(beam.folder)) == {"FINISHED"}
    scene = bpy.context.scene
    scene.frame_set(4)
    assert bpy.ops.limber.play() == {"FINISHED"}
    assert scene.frame_current == 1
    assert scene.frame_end == 6
    assert bpy.ops.limber.open_result(directory=str(beam.folder)) == {"FINISHED"}
    assert [c.name for c in scene.collection.children] == ["beam"], "opened anew, not twice"


@pytest.mark.slow
def test_open_result_of_a_damaged_folder(bpy, registered, beam):
    """The worker's complaint about a checksum reaches the user."""
    path = beam.folder / "plans" / "to-goal.csv"
    path.write_text(path.read_text().replace("0.0", "9.0"))
    with pytest.raises(RuntimeError, match="Damaged files"):
        bpy.ops.limber.open_result(directory=str(beam.folder))


@pytest.mark.slow
def test_play_says_when_the_frames_are_gone(bpy, worker_here, beam):
    """A cache that went missing is an error, not a branch that stands still."""
    bpy.ops.limber.open_result(directory=str(beam.folder))
    shutil.rmtree(beam.folder)
    with pytest.raises(RuntimeError, match="cannot be read"):
        bpy.ops.limber.play()


@pytest.mark.slow
def test_color_by_refuses_unknown(bpy, worker_here, beam):
    """Colouring by something that the branch does not have is an error."""
    bpy.ops.limber.open_result(directory=str(beam.folder))
    assert bpy.ops.limber.color_by(scalar="young") == {"FINISHED"}
    with pytest.raises(RuntimeError, match="has no 'stress'"):
        bpy.ops.limber.color_by(scalar="stress")


@pytest.mark.slow
def test_check_worker(bpy, registered):
    """The worker that is found answers."""
    assert bpy.ops.limber.check_worker() == {"FINISHED"}
    jobs = part("jobs.jobs")
    assert jobs.current().result["command"] == "doctor"


def test_no_worker(bpy, registered, monkeypatch):
    """Without a worker the error says how to bring one."""
    monkeypatch.setenv("LIMBER_PYTHON", "/nowhere/python")
    with pytest.raises(RuntimeError, match=r"Install that zip\. Or install the worker"):
        bpy.ops.limber.check_worker()


def _scan(path, shift):
    path.write_text("".join(f"{x} {shift} 0\n" for x in range(5)))
    return path


def _branch_of(scan, folder):
    """Write a branch folder that says it was made of ``scan``."""
    branch = Branch.create(folder)
    with branch.stage("reconstruct") as stage:
        stage.manifest.source = {"file": scan.name, "sha256": file_digest(scan)}
        stage.path("skeleton.swc").write_text("")
    return branch


def test_a_folder_belongs_to_its_scan(bpy, registered, tmp_path):
    """Another scan gets another folder; the first one again gets its own back."""
    (tmp_path / "other").mkdir()
    one, two = _scan(tmp_path / "a.xyz", 1), _scan(tmp_path / "b.xyz", 2)
    settings = bpy.context.scene.limber
    bpy.ops.limber.import_cloud(filepath=str(one))
    _branch_of(one, tmp_path / "a.branch")
    bpy.ops.limber.import_cloud(filepath=str(two))
    assert settings.branch_folder == str(tmp_path / "b.branch")
    bpy.ops.limber.import_cloud(filepath=str(one))
    assert settings.branch_folder == str(tmp_path / "a.branch")
    # The same name with other points: a new scan, whose results must not fall into the old folder.
    _scan(one, 3)
    bpy.ops.limber.import_cloud(filepath=str(one))
    assert settings.branch_folder == str(tmp_path / "a-2.branch")
    # A folder that the user chose, made of this scan, stays.
    _branch_of(one, tmp_path / "mine.branch")
    settings.branch_folder = str(tmp_path / "mine.branch")
    bpy.ops.limber.import_cloud(filepath=str(one))
    assert settings.branch_folder == str(tmp_path / "mine.branch")


def test_replacing_a_branch_has_to_be_said(bpy, registered, tmp_path, monkeypatch):
    """Reconstructing into the folder of another scan is refused unless it is asked for."""
    jobs = part("jobs.jobs")
    started = []
    monkeypatch.setattr(jobs, "start", lambda title, command, _: started.append(command) or 1 / 0)
    one, two = _scan(tmp_path / "a.xyz", 1), _scan(tmp_path / "b.xyz", 2)
    _branch_of(one, tmp_path / "a.branch")
    given = {"cloud": str(two), "output": str(tmp_path / "a.branch")}
    with pytest.raises(RuntimeError, match=r"was not made from b\.xyz"):
        bpy.ops.limber.reconstruct(**given)
    assert not started
    with pytest.raises(RuntimeError, match="division"):
        bpy.ops.limber.reconstruct(**given, replace=True)
    assert started[0][-1] == str(two)


def test_keywords_are_the_scenes_settings(bpy, registered, beam, monkeypatch):
    """What a script gives a stage is what the panels show, and what the worker gets."""
    jobs = part("jobs.jobs")
    # The branch has no energy field: here it is not sampled first.
    monkeypatch.delitem(part("jobs.steps").FIRST, "plan")
    started = []
    monkeypatch.setattr(jobs, "start", lambda title, command, _: started.append(command) or 1 / 0)
    with pytest.raises(RuntimeError, match="division"):
        bpy.ops.limber.plan(branch_folder=str(beam.folder), name="to-light", goal=(0.1, -0.2, 0.3),
                            max_force=2.5)
    assert started[0][3:] == [
        "plan", "--json", "--progress", "json", "--name", "to-light", "--goal", "0.1", "-0.2",
        "0.3", "--max-force", "2.5", "--", str(beam.folder)]
    assert bpy.context.scene.limber.plan.use_goal
    with pytest.raises(RuntimeError, match="Source is missing"):
        bpy.ops.limber.import_pull(name="one")


@pytest.mark.slow
def test_a_stage_runs_and_its_outcome_stays(bpy, registered, branch_folder):
    """The worker makes a report; its state is done; a failure and a warning are kept to be read."""
    steps = part("panels.steps")
    scene = bpy.context.scene
    assert bpy.ops.limber.report(branch_folder=str(branch_folder)) == {"FINISHED"}
    assert (branch_folder / "report.html").is_file()
    assert steps.state_of(scene, "report")[0] is steps.StepState.DONE
    with pytest.raises(RuntimeError, match="no estimate"):
        bpy.ops.limber.predict(weight=1.0)
    state, _ = steps.state_of(scene, "predict")
    assert state is steps.StepState.FAILED
    with pytest.raises(RuntimeError, match="Choose a branch folder"):
        bpy.ops.limber.estimate(branch_folder=str(branch_folder.parent))
    assert steps.state_of(scene, "predict")[0] is steps.StepState.NOT_RUN, "of another branch"


def test_places_come_from_the_cursor(bpy, registered):
    """A place field takes the 3D cursor; what is no place is refused."""
    scene = bpy.context.scene
    scene.cursor.location = (0.1, 0.2, 0.3)
    assert bpy.ops.limber.from_cursor(stage="plan", field="goal") == {"FINISHED"}
    assert list(scene.limber.plan.goal) == pytest.approx([0.1, 0.2, 0.3])
    assert scene.limber.plan.use_goal
    with pytest.raises(RuntimeError, match="no position 'seed'"):
        bpy.ops.limber.from_cursor(stage="plan", field="seed")


def test_import_stands_in_the_file_menu(bpy, registered):
    """File > Import has the scan, so that F3 finds it; and it goes with the add-on."""
    menu = bpy.types.TOPBAR_MT_file_import
    imports = part("scan.import_cloud")
    assert imports._draw_menu in menu._dyn_ui_initialize()
    assert bpy.types.LIMBER_FH_cloud.bl_import_operator == "limber.import_cloud"


def test_a_scan_of_more_units_than_a_plant_has_metres_is_in_millimetres(bpy, registered, tmp_path):
    """From the worker's limit on: guessed and asked, unless the user has set the unit."""
    limit = part("jobs.stages").longest_m()
    assert limit == LONGEST
    np.savetxt(tmp_path / "a.xyz", POINTS * 1.1 * limit / np.ptp(POINTS, axis=0).max())
    settings = bpy.context.scene.limber.reconstruct
    bpy.ops.limber.import_cloud(filepath=str(tmp_path / "a.xyz"))
    assert settings.unit == "mm"
    assert list(bpy.data.objects["a scan"].scale) == pytest.approx([0.001] * 3)
    for unit in ("cm", "m"):
        settings.unit = unit
        bpy.ops.limber.import_cloud(filepath=str(tmp_path / "a.xyz"))
        assert settings.unit == unit
    # The worker would ask for it again.
    stages, properties = (part(name) for name in ("jobs.stages", "properties"))
    settings.output = "a.branch"
    typed = properties.arguments_of(bpy.context.scene, stages.stages()["reconstruct"], "a.branch")
    assert typed[typed.index("--unit") + 1] == "m"


def test_map_coordinates_keep_their_digits(bpy, registered, tmp_path):
    """A scan in a map's coordinates: a millimetre is still there, and it comes to its branch."""
    meshes = part("bridge.meshes")
    scene = part("show.scene")
    points = np.array([[432100.001, 5412300.002, 512.003], [432100.501, 5412300.102, 513.0]])
    (tmp_path / "map.xyz").write_text("".join(f"{x} {y} {z}\n" for x, y, z in points))
    bpy.ops.limber.import_cloud(filepath=str(tmp_path / "map.xyz"))
    cloud = bpy.data.objects["map scan"]
    branches = part("branch.branches")
    offset = np.array(cloud[branches.OFFSET_KEY])
    np.testing.assert_allclose(meshes.positions(cloud.data) + offset, points, rtol=0, atol=1e-6)
    alignment = np.eye(4)
    alignment[:3, 3] = -points[0]
    data = SimpleNamespace(info={"source": {"sha256": cloud[scene.SCAN_KEY]},
                                 "alignment": alignment.tolist()})
    scene.place_scans(bpy.context.scene, data)
    bpy.context.view_layer.update()
    placed = [np.array(cloud.matrix_world @ vertex.co) for vertex in cloud.data.vertices]
    np.testing.assert_allclose(placed, points - points[0], rtol=0, atol=1e-5)


def test_a_job_that_blender_ends_is_no_failure(bpy, registered, tmp_path):
    """File > New while the worker works: the panel of the new file shows no failure."""
    jobs = part("jobs.jobs")
    operators = part("jobs.worker_operator")
    job = jobs.start("Working", [sys.executable, "-c", "import time; time.sleep(60)"])
    operators._beside.append(operators._Beside("limber.energy", job, {}, {}))
    bpy.ops.wm.read_homefile()
    assert job.state is jobs.JobState.CANCELLED and not job.error
    assert job._process.stdout.closed and job._process.stderr.closed
    assert jobs.current() is None and operators._look() is None
