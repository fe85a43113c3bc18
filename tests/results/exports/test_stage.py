"""`limber export`: the suffix says what; cylinder models come back as they went out."""

from pathlib import Path

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.io.skeletons import read_skeleton
from limber.stages.results.export import Export
from limber.store import Branch
from limber.store.loading import load_skeleton

EXAMPLE = Path(__file__).parents[3] / "blend_files" / "bending_branch"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "columns"), [
    ("a.mat", "rtwig"), ("a.csv", "rtwig"), ("a.csv", "simpleforest"), ("a.swc", "rtwig"),
    ("a.mtg", "rtwig")])
def test_cylinder_models_come_back(tmp_path, name, columns):
    """TreeQSM, rTwig, SimpleForest, SWC and MTG: the same tree, places and radii."""
    told = Export(branch_folder=EXAMPLE, output=tmp_path / name, columns=columns).run()
    before, after = load_skeleton(Branch.open(EXAMPLE)), read_skeleton(tmp_path / name)
    assert after.node_count == before.node_count == told.get("cylinder_count") + 1
    np.testing.assert_allclose(after.nodes, before.nodes, atol=1e-6)
    np.testing.assert_allclose(after.radius[1:], before.radius[1:], rtol=1e-4)
    np.testing.assert_array_equal(after.parent, before.parent)


def test_simulators_files_are_written(tmp_path):
    """MJCF with the tip as a site, URDF, Abaqus input; springs are scaled by a few percent."""
    from xml.etree import ElementTree

    links = {}
    for name in ("a.xml", "a.urdf"):
        told = Export(branch_folder=EXAMPLE, output=tmp_path / name, links=8).run()
        assert 0.7 < told["stiffness_factor"] < 1.3 and told["mass_kg"] > 0
        links[name] = told["link_count"]
    bodies = ElementTree.parse(tmp_path / "a.xml").getroot().findall(".//body")
    assert len(bodies) == links["a.xml"] == links["a.urdf"]
    assert ElementTree.parse(tmp_path / "a.xml").find(".//site[@name='tip']") is not None
    told = Export(branch_folder=EXAMPLE, output=tmp_path / "a.inp", load=(0.1, 0.0, 0.0)).run()
    text = (tmp_path / "a.inp").read_text()
    assert "*CLOAD" in text and text.count("*ELEMENT") == 1
    assert f"*NSET, NSET=TIP\n{told['tip_node']}\n" in text


def test_an_swc_opens_in_morphio(tmp_path):
    """It refuses others: "section type changed without a bifurcation"."""
    Export(branch_folder=EXAMPLE, output=tmp_path / "a.swc").run()
    assert set(np.loadtxt(tmp_path / "a.swc")[:, 1]) == {3}
    morphio = pytest.importorskip("morphio", reason="MorphIO is not installed")
    sections = morphio.Morphology(tmp_path / "a.swc").iter()
    length = sum(np.linalg.norm(np.diff(each.points, axis=0), axis=1).sum() for each in sections)
    assert length == pytest.approx(load_skeleton(Branch.open(EXAMPLE)).length, rel=1e-3)


def test_an_mtg_has_a_line_for_each_node(tmp_path):
    """Axes follow with <, side axes with +; places and radii stand in their columns."""
    Export(branch_folder=EXAMPLE, output=tmp_path / "a.mtg").run()
    skeleton = load_skeleton(Branch.open(EXAMPLE))
    lines = (tmp_path / "a.mtg").read_text().splitlines()
    nodes = [line for line in lines if line.strip().startswith(("^/N", "^<N", "+N"))]
    assert len(nodes) == skeleton.node_count
    sides = [line for line in nodes if line.strip().startswith("+")]
    assert len(sides) == skeleton.branch_count - 1
    last = [float(word) for word in nodes[0].split("\t")[-4:]]
    np.testing.assert_allclose(last, [*skeleton.nodes[0], skeleton.radius[0]], atol=1e-9)


def test_what_cannot_be_written_is_told(tmp_path):
    """Unknown suffixes list the known ones."""
    with pytest.raises(InputError, match=r"\.urdf"):
        Export(branch_folder=EXAMPLE, output=tmp_path / "a.sdf").run()


@pytest.mark.slow
def test_a_mat_file_of_something_else_is_refused(tmp_path):
    """A MAT file without cylinders, and bytes that are none."""
    from scipy.io import savemat

    savemat(tmp_path / "a.mat", {"x": np.arange(3)})
    (tmp_path / "b.mat").write_bytes(b"MATLAB 5.0" + bytes(200))
    for name in ("a.mat", "b.mat"):
        with pytest.raises(InputError, match=name):
            read_skeleton(tmp_path / name)
