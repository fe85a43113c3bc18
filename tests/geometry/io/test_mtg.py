"""MTG text as OpenAlea's users write it, and what cannot be read of it."""

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.io.skeletons import read_skeleton

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
    assert parents_of(read(tmp_path, PARTS)) == {(0, 0, 100): (0, 0, 0),
                                                 (0, 0, 200): (0, 0, 100)}


@pytest.mark.parametrize(("body", "head", "told"), [
    ("^/P1\n", HEAD, "refers to a vertex that does not exist"),
    ("/P1/X1\t\t\t0\t0\t\t0\t1\n", HEAD, "The file has no class X"),
    ("/P1/A1)\t\t\t0\t0\t\t0\t1\n", HEAD, "a code consists of"),
    ("/P1/U1/A1\t\t\t0\t0\t\t0\t1\n", HEAD, "finer scale"),
    ("/P1/A1/U1\t\t\t0\tx\t\t0\t1\n", HEAD, "must be numbers"),
    ("/P1/A1/U1\t\t\t0\tinf\t\t0\t1\n", HEAD, "finite"),
    ("/P1/A1/U1\t\t\t0\t0\t\t0\n", HEAD, "no radius"),
    ("/P1\n", HEAD, "0 vertices"),
    (FLAT + "/P2/A1/U1\t\t\t0\t0\t\t0\t8\n", HEAD, "2 vertices"),
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
