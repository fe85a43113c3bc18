"""The add-on's reader of scene data: what fits is read, all else is refused with a reason."""

import io
import json
import os
import zipfile

import numpy as np
import pytest
from tests.addon.conftest import part

from limber.results.scene.animation import scene_data
from limber.results.scene.colours import FORMAT
from limber.store import Branch


@pytest.fixture()
def reader(addon):
    return part("show.scene_data")


@pytest.fixture()
def data(beam):
    return scene_data(Branch.open(beam.folder))


def test_formats_are_one(reader):
    """Worker and add-on of one version speak of one format."""
    assert reader.FORMAT == FORMAT


def test_what_was_written_is_read(reader, data, tmp_path):
    """Every array comes back bit for bit."""
    data.write(tmp_path / "data.npz")
    read = reader.read_scene_data(tmp_path / "data.npz")
    assert set(read.arrays) == set(data.arrays)
    for name, array in data.arrays.items():
        np.testing.assert_array_equal(read.arrays[name], array)
    assert read.info["frames"] == data.info["frames"]


def _longer(arrays, name):
    arrays[name] = np.concatenate([arrays[name], arrays[name][:1]])


def _set(arrays, name, value):
    array = np.array(arrays[name])
    array.flat[-1] = value
    arrays[name] = array


@pytest.mark.parametrize(("change", "words"), [
    (lambda d: d.info.update(format=1), "format 1"),
    (lambda d: d.info.update(format=FORMAT + 1), "the same version"),
    (lambda d: d.info.pop("alignment"), "alignment"),
    (lambda d: d.info.update(alignment=[[1.0]]), "alignment"),
    (lambda d: d.info["scalars"].update(more={}), "scalar:more"),
    (lambda d: d.info["frames"].update(count=99), "frames"),
    (lambda d: d.arrays.pop("vertices"), "vertices"),
    (lambda d: d.arrays.pop("grasp_radius"), "grasp_radius"),
    (lambda d: d.info.update(targets=["flower"]), "targets"),
    (lambda d: _set(d.arrays, "vertices", np.nan), "not finite"),
    (lambda d: _set(d.arrays, "faces", 10**6), "indices outside the"),
    (lambda d: _set(d.arrays, "faces", -1), "indices outside the"),
    (lambda d: _longer(d.arrays, "scalar:young"), "young"),
    (lambda d: _longer(d.arrays, "control_points_motion"), "shape"),
    (lambda d: d.arrays.update(faces=d.arrays["faces"].astype(float)), "invalid type float64"),
    (lambda d: d.arrays.update(vertices=d.arrays["vertices"][:, :2]), "shape"),
    (lambda d: d.arrays.update(skeleton_parent=np.array([-1, 1])), "not a tree"),
])
def test_what_does_not_fit_is_refused(reader, data, tmp_path, change, words):
    """Another version, missing arrays, wrong sizes, indices and numbers: named, nothing drawn."""
    change(data)
    data.write(tmp_path / "data.npz")
    with pytest.raises(reader.SceneDataError, match=words):
        reader.read_scene_data(tmp_path / "data.npz")


def test_no_header_is_believed(reader, data, tmp_path):
    """A member whose header speaks of a terabyte, of objects, or is compressed, is not read."""
    huge = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        huge, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)})
    objects = io.BytesIO()
    np.save(objects, np.array([None], dtype=object), allow_pickle=True)
    for name, content in (("huge", huge.getvalue()), ("objects", objects.getvalue()),
                          ("text", b"no array"),
                          ("words", np.lib.format.magic(1, 0) + b"\x0b\0{'shape': ((")):
        path = tmp_path / f"{name}.npz"
        data.write(path)
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr("more.npy", content)
        with pytest.raises(reader.SceneDataError):
            reader.read_scene_data(path)
    np.savez_compressed(tmp_path / "small.npz", info=np.array(json.dumps({"format": FORMAT})),
                        vertices=np.zeros((10**6, 3)))
    with pytest.raises(reader.SceneDataError, match="compressed"):
        reader.read_scene_data(tmp_path / "small.npz")


def test_damaged_files_are_refused(reader, data, tmp_path):
    """Cut anywhere or changed anywhere: read right, or refused; never another exception."""
    data.write(tmp_path / "data.npz")
    whole = (tmp_path / "data.npz").read_bytes()
    path = tmp_path / "damaged.npz"
    rng = np.random.default_rng(1)
    refused = 0
    for number in range(120):
        damaged = bytearray(whole[:rng.integers(0, len(whole))] if number % 2 else whole)
        for at in rng.integers(0, len(damaged), 3) if damaged else ():
            damaged[at] ^= rng.integers(1, 256)
        path.write_bytes(damaged)
        try:
            reader.read_scene_data(path)
        except reader.SceneDataError:
            refused += 1
    assert refused > 60
    with pytest.raises(reader.SceneDataError):
        reader.read_scene_data(tmp_path / "missing.npz")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes")
def test_a_pipe_in_a_branch_folder_is_not_waited_for(addon, tmp_path):
    """Nobody writes to it: Blender would stand still at the next redraw."""
    for module, name, function in (("branch.branch_folder", "branch.json", "read_record"),
                                   ("plan.live_force", None, "read")):
        reader = part(module)
        os.mkfifo(tmp_path / (name or reader.FILE))
        assert getattr(reader, function)(tmp_path) is None
