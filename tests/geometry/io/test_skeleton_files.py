"""Skeletons of other programs: MTG text and Matlab's files."""

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
from limber.geometry.io.skeletons import read_skeleton
from limber.geometry.skeleton.skeleton import Skeleton

# MTG text as OpenAlea's users write it, and what cannot be read of it.

HEAD = """# measured by hand
CODE :\tFORM-A

CLASSES :
SYMBOL\tSCALE\tDECOMPOSITION\tINDEXATION\tDEFINITION
$\t0\tFREE\tFREE\tIMPLICIT
P\t1\tFREE\tFREE\tEXPLICIT
A\t2\tFREE\tFREE\tEXPLICIT
U\t3\tFREE\tFREE\tEXPLICIT

DESCRIPTION :
LEFT\tRIGHT\tRELTYPE\tMAX
U\tU\t<\t1
U\tU\t+\t?

FEATURES:
NAME\tTYPE
XX\tREAL
YY\tREAL
ZZ\tREAL
diam\tREAL

MTG :
TOPO\t\t\tXX\tYY\t\tZZ\tdiam
"""
FLAT = """/P1/A1/U1\t\t\t0\t0\t\t0\t8
^<U2\t\t\t0\t0\t\t100\t7
\t+A2/U1\t\t50\t0\t\t150\t3
\t^<U2\t\t80\t0\t\t180
\t\t+U1\t90\t10\t\t190\t1
^<U3<<U5\t\t\t0\t0\t\t200\t5
"""
PARTS = """/P1
\t/A1
\t\t/U1\t0\t0\t\t0\t8
\t\t^<U2\t0\t0\t\t100\t7
\t^<A2
\t\t/U1\t0\t0\t\t200\t6
"""


def read(tmp_path, body, head=HEAD):
    path = tmp_path / "a.mtg"
    path.write_text(head + body)
    return read_skeleton(path, scale=1e-3)


def parents_of(skeleton) -> dict[tuple, tuple]:
    """The place [mm] of each node's parent, by the node's own."""
    places = [tuple(int(v) for v in row) for row in np.round(1e3 * skeleton.nodes)]
    return {places[node]: places[up] for node, up in enumerate(skeleton.parent) if up >= 0}


def test_chains_side_axes_and_series(tmp_path):
    """Places, halves of diameters, inherited ones; a side axis hangs where it was told."""
    found = read(tmp_path, FLAT)
    assert parents_of(found) == {
        (0, 0, 100): (0, 0, 0), (50, 0, 150): (0, 0, 100), (80, 0, 180): (50, 0, 150),
        (90, 10, 190): (80, 0, 180), (0, 0, 200): (0, 0, 100)}
    radius = {tuple(np.round(1e3 * node).astype(int)): 1e3 * r
              for node, r in zip(found.nodes, found.radius, strict=True)}
    assert radius[0, 0, 0] == pytest.approx(4.0) and radius[80, 0, 180] == pytest.approx(1.5)


def test_an_axis_goes_on_where_the_parts_of_the_one_before_end(tmp_path):
    assert parents_of(read(tmp_path, PARTS)) == {(0, 0, 100): (0, 0, 0), (0, 0, 200): (0, 0, 100)}


@pytest.mark.parametrize(("body", "head", "told"), [
    ("^/P1\n", HEAD, "refers to a vertex that does not exist"),
    ("/P1/X1\t\t\t0\t0\t\t0\t1\n", HEAD, "The file has no class X"),
    ("/P1/A1)\t\t\t0\t0\t\t0\t1\n", HEAD, "does not consist of"),
    ("/P1/U1/A1\t\t\t0\t0\t\t0\t1\n", HEAD, "finer scale"),
    ("/P1/A1/U1\t\t\t0\tx\t\t0\t1\n", HEAD, "could not convert"),
    ("/P1/A1/U1\t\t\t0\tinf\t\t0\t1\n", HEAD, "finite"),
    ("/P1/A1/U1\t\t\t0\t0\t\t0\n", HEAD, "no radius"),
    ("/P1\n", HEAD, "0 vertices"),
    (FLAT + FLAT.replace("/P1", "/P2").replace("\t0\t8", "\t1\t8"), HEAD, "2 trees"),
    (FLAT, HEAD.replace("diam", "mass"), "no column Radius"),
    (FLAT, HEAD.replace("\tZZ\t", "\tH\t"), "XX, YY and ZZ"),
    ("", "CODE:\n", "no section"),
])
def test_what_is_wrong_is_told(tmp_path, body, head, told):
    with pytest.raises(InputError, match=f"(?i){told}"):
        read(tmp_path, body, head)


def test_a_smartqsm_model(tmp_path):
    """Its fields and types: unsigned parents, thin ends, thick ends beside them, two roots."""
    from scipy.io import savemat

    start = np.array([[0, 0, 0], [0, 0, 0.5], [0, 0, 0.5], [0, 0, 0.0]])
    axis = np.array([[0, 0, 1], [0, 0, 1], [1, 0, 0], [0, 1, 0]], np.float32)
    column = {"radius": [0.03, 0.02, 0.01, 0.01], "length": [0.5, 0.5, 0.3, 0.2],
              "UnmodRadius": [0.04, 0.03, 0.015, 0.012]}
    savemat(tmp_path / "a_qsm.mat", {"QSM": {
        "cylinder": {name: np.array(values, np.float32)[:, None]
                     for name, values in column.items()} | {
            "start": start, "axis": axis, "parent": np.array([[0], [1], [1], [0]], np.uint64),
            "extension": np.array([[2], [0], [0], [0]], np.uint64),
            "added": np.zeros((4, 1), bool), "simplified": np.zeros((4, 1), bool)},
        "rundata": {"creator": "SmartQSM", "projection": ""}}})
    found = read_skeleton(tmp_path / "a_qsm.mat")
    assert found.node_count == 5 and found.radius[0] == pytest.approx(0.04)
    ends = {tuple(np.round(found.nodes[n], 3)): tuple(np.round(found.nodes[found.parent[n]], 3))
            for n in range(1, 5)}
    assert ends == {(0, 0, 0.5): (0, 0, 0), (0, 0, 1): (0, 0, 0.5), (0.3, 0, 0.5): (0, 0, 0.5),
                    (0, 0.2, 0): (0, 0, 0)}


# TreeQSM models in files of Matlab's version 7.3: read as those of version 7, or refused.

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


@pytest.mark.slow
def test_it_is_read_as_one_of_version_7(tmp_path):
    write_treeqsm(AXIS, tmp_path / "old.mat")
    old, new = read_treeqsm(tmp_path / "old.mat"), read_treeqsm(written(tmp_path / "new.mat"))
    assert old.keys() == new.keys()
    for name in old.keys() - {"notes"}:
        np.testing.assert_allclose(new[name], old[name], atol=1e-8)


@pytest.mark.parametrize("count", [1, 3])
def test_without_distances_the_first_model_counts_and_all_are_listed(tmp_path, count):
    found = mat_v73_fields(written(tmp_path / "a.mat", count=count, creator="SmartQSM"))
    assert set(found) == {*TREEQSM_FIELDS, "UnmodRadius", "creator", "models", "taken"}
    np.testing.assert_allclose(found["start"], fields()["start"])
    assert str(found["creator"]) == "SmartQSM" and found["UnmodRadius"].shape == (7, 1)
    assert len(found["models"]) == count and found["taken"] == 1


def test_loose_vertices_of_a_graph_are_left_out(tmp_path):
    graph = read(tmp_path, FLAT + "/P2/A1/U1\t\t\t0\t0\t\t999\t8\n")
    assert graph.node_count == 6 and "1 of 7 parts" in graph.notes[0]


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
    with pytest.raises(MissingDependencyError, match=r"-v7 avoids this\).*(--with |\[)matlab"):
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
