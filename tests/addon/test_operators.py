"""What a user's actions do, from the bpy package: errors are clear, results are right."""

import importlib
import shutil
import struct

import numpy as np
import pytest

POINTS = np.random.default_rng(7).random((40, 3)) * 300


def _ply(path, kind):
    order = {"ascii": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[kind]
    head = (f"ply\nformat {order} 1.0\ncomment made here\nelement vertex {len(POINTS)}\n"
            "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
            "end_header\n")
    if kind == "ascii":
        body = "".join(f"{x:.9g} {y:.9g} {z:.9g} 7\n" for x, y, z in POINTS).encode()
    else:
        body = b"".join(struct.pack(f"{kind}fffB", *point, 7) for point in POINTS)
    path.write_bytes(head.encode() + body)


def _text(path, delimiter, header):
    lines = [header] if header else []
    lines += [delimiter.join(f"{value:.9g}" for value in (*point, 9.0)) for point in POINTS]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(("name", "write"), [
    ("a.ply", lambda path: _ply(path, "ascii")),
    ("b.ply", lambda path: _ply(path, "<")),
    ("c.ply", lambda path: _ply(path, ">")),
    ("d.xyz", lambda path: _text(path, " ", "")),
    ("e.csv", lambda path: _text(path, ",", "x,y,z,intensity")),
    ("f.txt", lambda path: _text(path, ";", "")),
])
def test_import_cloud(bpy, registered, tmp_path, name, write):
    """Every kind of file shows its points, in metres, and proposes a branch folder beside it."""
    meshes = importlib.import_module("limber_addon.bridge.meshes")
    write(tmp_path / name)
    settings = bpy.context.scene.limber
    settings.cloud_unit = "mm"
    assert bpy.ops.limber.import_cloud(filepath=str(tmp_path / name)) == {"FINISHED"}
    cloud = bpy.data.objects[f"{name[0]} scan"]
    np.testing.assert_allclose(meshes.positions(cloud.data), POINTS, rtol=1e-5)
    assert list(cloud.scale) == pytest.approx([0.001] * 3)
    assert settings.branch_folder == str(tmp_path / f"{name[0]}.branch")


@pytest.mark.parametrize("content", [
    b"", b"ply\nformat ascii 1.0\n", b"1 2 nan\n", b"a b c\nd e f\n",
    b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\n"
    b"property float y\nproperty float z\nend_header\nxx"])
def test_bad_clouds_are_refused(bpy, registered, tmp_path, content):
    """An empty, truncated or non-numeric file is an error that names it; nothing is added."""
    for name in ("bad.ply", "bad.xyz"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(RuntimeError, match=name):
            bpy.ops.limber.import_cloud(filepath=str(tmp_path / name))
    assert not bpy.data.objects


def test_reconstruct_wants_a_scan(bpy, registered):
    """Without a scan no worker is started; the message says what to choose."""
    with pytest.raises(RuntimeError, match="Choose a scan first"):
        bpy.ops.limber.reconstruct()


def test_reconstruct_hands_the_worker_what_the_user_chose(bpy, registered, tmp_path, monkeypatch):
    """The worker gets file, folder and unit; its error reaches the user as it is."""
    jobs = importlib.import_module("limber_addon.jobs")
    seen = []
    start = jobs.start
    monkeypatch.setattr(jobs, "start", lambda title, command: seen.append(command) or start(
        title, [command[0], "-c", "print('{\"status\": \"failed\", \"error\": \"Too few.\"}');"
                                  "raise SystemExit(2)"]))
    (tmp_path / "scan.xyz").write_text("0 0 0\n")
    settings = bpy.context.scene.limber
    settings.cloud_path, settings.cloud_unit = str(tmp_path / "scan.xyz"), "mm"
    with pytest.raises(RuntimeError, match="Too few"):
        bpy.ops.limber.reconstruct()
    assert seen[0][1:] == ["-m", "limber", "reconstruct", str(tmp_path / "scan.xyz"), "-o",
                           str(tmp_path / "scan.branch"), "--unit", "mm", "--json", "--progress",
                           "json"]


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


def test_open_result_refuses_other_folders(bpy, registered, tmp_path):
    """A folder without branch.json is refused before the worker is asked."""
    with pytest.raises(RuntimeError, match=r"branch\.json"):
        bpy.ops.limber.open_result(directory=str(tmp_path))


def test_open_result_of_a_damaged_folder(bpy, registered, beam):
    """The worker's complaint about a checksum reaches the user."""
    path = beam.folder / "plans" / "to-goal.csv"
    path.write_text(path.read_text().replace("0.0", "9.0"))
    with pytest.raises(RuntimeError, match="Damaged files"):
        bpy.ops.limber.open_result(directory=str(beam.folder))


def test_play_says_when_the_frames_are_gone(bpy, registered, beam):
    """A cache that went missing is an error, not a branch that stands still."""
    bpy.ops.limber.open_result(directory=str(beam.folder))
    shutil.rmtree(beam.folder)
    with pytest.raises(RuntimeError, match="cannot be read"):
        bpy.ops.limber.play()


def test_color_by_refuses_unknown(bpy, registered, beam):
    """Colouring by something that the branch does not have is an error."""
    bpy.ops.limber.open_result(directory=str(beam.folder))
    assert bpy.ops.limber.color_by(scalar="young") == {"FINISHED"}
    with pytest.raises(RuntimeError, match="has no 'stress'"):
        bpy.ops.limber.color_by(scalar="stress")


def test_check_worker(bpy, registered):
    """The worker that is found answers."""
    assert bpy.ops.limber.check_worker() == {"FINISHED"}
    jobs = importlib.import_module("limber_addon.jobs")
    assert jobs.current().result["command"] == "doctor"


def test_no_worker(bpy, registered, monkeypatch):
    """Without a worker the error says how to bring one."""
    monkeypatch.setenv("LIMBER_PYTHON", "/nowhere/python")
    with pytest.raises(RuntimeError, match="does not bring along yet"):
        bpy.ops.limber.check_worker()
