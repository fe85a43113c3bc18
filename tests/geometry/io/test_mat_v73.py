"""TreeQSM models in files of Matlab's version 7.3: read as those of version 7, or refused."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from limber.core.errors import InputError, MissingDependencyError
from limber.geometry.io import cylinder_models
from limber.geometry.io.cylinder_models import (
    TREEQSM_FIELDS,
    mat_v73_fields,
    read_treeqsm,
    write_treeqsm,
)
from limber.geometry.skeleton.skeleton import Skeleton

h5py = pytest.importorskip("h5py")

AXIS = Skeleton.from_edges(
    np.column_stack([np.linspace(0, 0.1, 8), np.zeros(8), np.linspace(0, 0.7, 8)]),
    np.arange(-1, 7), np.linspace(0.02, 0.01, 8))


def fields() -> dict[str, np.ndarray]:
    """The cylinders as Matlab has them, shape [rows, columns]."""
    start, end = AXIS.nodes[:-1], AXIS.nodes[1:]
    length = np.linalg.norm(end - start, axis=1)
    return {"radius": AXIS.radius[1:, None].astype(np.float32), "length": length[:, None],
            "start": start, "axis": (end - start) / length[:, None],
            "parent": np.arange(7, dtype=np.uint32)[:, None], "note": np.zeros((2, 2))}


def written(path: Path, *, count: int = 1, creator: str = "") -> Path:
    """Write the file as Matlab does: a header of 512 bytes, arrays transposed, structs as groups;
    of several structs each field is an array of references."""
    with h5py.File(path, "w", userblock_size=512) as file:
        tree = file.create_group("QSM")
        if count > 1:
            kept = [file.create_group(f"#refs#/{number}") for number in range(count)]
            tree.create_dataset("cylinder", (1, count), h5py.ref_dtype)[0] = [
                one.ref for one in kept]
        else:
            kept = [tree.create_group("cylinder")]
        for number, one in enumerate(kept):
            for name, values in fields().items():
                one.create_dataset(name, data=values.T + (number if name == "start" else 0))
            if creator:
                one.create_dataset("UnmodRadius", data=2 * fields()["radius"].T)
        if creator:
            letters = np.array([[ord(letter)] for letter in creator], np.uint16)
            tree.create_dataset("rundata/creator", data=letters)
    with open(path, "r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(512))
    return path


def test_it_is_read_as_one_of_version_7(tmp_path):
    write_treeqsm(AXIS, tmp_path / "old.mat")
    old, new = read_treeqsm(tmp_path / "old.mat"), read_treeqsm(written(tmp_path / "new.mat"))
    assert old.keys() == new.keys()
    for name in old:
        np.testing.assert_allclose(new[name], old[name], atol=1e-8)


@pytest.mark.parametrize("count", [1, 3])
def test_of_several_models_the_first_counts(tmp_path, count):
    found = mat_v73_fields(written(tmp_path / "a.mat", count=count, creator="SmartQSM"))
    assert set(found) == {*TREEQSM_FIELDS, "UnmodRadius", "creator"}
    np.testing.assert_allclose(found["start"], fields()["start"])
    assert str(found["creator"]) == "SmartQSM" and found["UnmodRadius"].shape == (7, 1)


def test_nothing_outside_the_file_is_read(tmp_path):
    """Links and raw data in other files are not followed."""
    other = written(tmp_path / "other.mat")
    with h5py.File(tmp_path / "linked.mat", "w") as file:
        file["QSM"] = h5py.ExternalLink(str(other), "/QSM")
    assert mat_v73_fields(tmp_path / "linked.mat") == {}
    (tmp_path / "raw").write_bytes(bytes(7 * 8))
    with h5py.File(written(tmp_path / "raw.mat"), "r+") as file:
        del file["QSM/cylinder/length"]
        file["QSM/cylinder"].create_dataset("length", (1, 7), float,
                                            external=[(str(tmp_path / "raw"), 0, 56)])
    with pytest.raises(ValueError, match="other files"):
        mat_v73_fields(tmp_path / "raw.mat")


def test_what_is_wrong_is_said(tmp_path, monkeypatch):
    """No numbers, a vast array, a torn file, no h5py."""
    with h5py.File(written(tmp_path / "text.mat"), "r+") as file:
        del file["QSM/cylinder/radius"]
        file["QSM/cylinder/radius"] = "text"
    with pytest.raises(ValueError, match="of a cylinder must be numbers"):
        mat_v73_fields(tmp_path / "text.mat")
    with h5py.File(written(tmp_path / "vast.mat"), "r+") as file:
        del file["QSM/cylinder/radius"]
        file["QSM/cylinder"].create_dataset("radius", (1, 10**12), float, chunks=(1, 1000))
    with pytest.raises(ValueError, match="announces an array"):
        mat_v73_fields(tmp_path / "vast.mat")
    torn = tmp_path / "torn.mat"
    torn.write_bytes(written(tmp_path / "whole.mat").read_bytes()[:2000])
    with pytest.raises(InputError, match=r"torn\.mat cannot be read"):
        read_treeqsm(torn)
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec",
                        lambda name, *more: None if name == "h5py" else found(name, *more))
    with pytest.raises(MissingDependencyError, match=r"-v7 avoids this\).* install .*\[matlab\]"):
        read_treeqsm(tmp_path / "whole.mat")


def test_an_older_version_is_read_in_a_process_of_its_own(tmp_path, monkeypatch):
    """scipy's compiled reader crashed on a damaged file, and Limber with it."""
    asked = []
    monkeypatch.setattr(cylinder_models, "read_apart",
                        lambda reader, path: asked.append(reader) or {})
    path = tmp_path / "old.mat"
    scipy.io.savemat(path, {"a": 1.0})
    with pytest.raises(InputError, match="no struct with the fields"):
        read_treeqsm(path)
    assert asked == [cylinder_models.mat_fields]
