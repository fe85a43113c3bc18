"""MJCF, URDF and Abaqus input of a small branch, loaded by the programs that they are for."""

import shutil

import numpy as np
import pytest
from tests.subjects.other_programs import bent_here, bent_in_calculix, bent_in_mujoco

from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.model import BranchModel
from limber.results.exports.rigid_links import mjcf_text, rod_tree, tip_compliance, urdf_text
from limber.results.exports.volumes import as_deformable, inp_text, write_usd

LOAD = np.array([0.01, 0.006, 0.0])


@pytest.fixture(scope="module")
def prestress(small, small_bench):
    """The small branch under its weight."""
    return BranchModel(small_bench.mesh, young=2e8, poisson=0.36, density=900.0).as_scanned()


@pytest.fixture(scope="module")
def tree(prestress, small):
    return rod_tree(prestress, small.skeleton, small.skeleton.length / 10)


def test_links_have_the_branchs_mass_and_rest_as_scanned(tree, prestress):
    """All mass is in the links; each spring carries what hangs beyond it."""
    assert tree.mass.sum() == pytest.approx(prestress.total_mass, rel=1e-6)
    middle = np.einsum("n,ni->i", tree.mass, tree.centre) / tree.mass.sum()
    own, _ = prestress.nodal_masses
    np.testing.assert_allclose(middle, own @ prestress.mesh.nodes / own.sum(), atol=1e-3)
    assert (tree.stiffness[1:] > 0).all() and (tree.parent[1:] < np.arange(1, tree.count)).all()
    assert np.abs(tree.carried[1]).max() > 0


def test_mujoco_holds_it_at_rest_and_bends_it_as_we_do(tree, prestress, small):
    """At rest nothing moves; static tip and first frequency agree to 2 % with 30 links."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(mjcf_text(tree, RayleighDamping(), "b", {}))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert np.abs(data.qacc).max() < 1e-3
    node = int(np.linalg.norm(prestress.mesh.nodes - small.skeleton.nodes[-1], axis=1).argmin())
    ours = bent_here(prestress, node, LOAD)
    theirs = bent_in_mujoco(prestress, small.skeleton, prestress.mesh.nodes[node], LOAD, links=30)
    assert np.linalg.norm(theirs.tip - ours.tip) < 0.02 * np.linalg.norm(ours.tip)
    assert theirs.frequency == pytest.approx(ours.frequency, rel=0.02)


def test_urdf_has_the_same_links(tree):
    """MuJoCo reads the URDF: as much mass, three joints for each link but the held one."""
    mujoco = pytest.importorskip("mujoco")
    text = urdf_text(tree, RayleighDamping(0.0, 2e-3), "b")
    model = mujoco.MjModel.from_xml_string(text)
    assert model.njnt == 3 * (tree.count - 1)
    # The held link is part of the world there.
    assert model.body_mass.sum() == pytest.approx(tree.mass[1:].sum(), rel=1e-3)
    assert f"<springStiffness>{tree.stiffness[1, 0]:.9g}</springStiffness>" in text


def test_abaqus_input_names_what_it_must(small_bench):
    """Nodes, C3D10 in our own order, one material for equal moduli, sets and steps."""
    mesh = small_bench.mesh
    young = np.where(np.arange(mesh.tet_count) % 2, 1e8, 2e8)
    model = BranchModel(mesh, young=young, poisson=0.36, density=900.0, gravity=None)
    text = inp_text(model, "b", 3, LOAD)
    lines = text.splitlines()
    first = lines.index("*ELEMENT, TYPE=C3D10, ELSET=BRANCH") + 1
    assert lines[first] == ", ".join(map(str, (1, *(mesh.tets[0] + 1))))
    assert text.count("*MATERIAL") == 2 and "BASE, 1, 3" in lines and "*FREQUENCY" in lines


@pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX (ccx) is not on the PATH")
def test_calculix_bends_it_as_we_do(small_bench, small):
    """The same elements: tip and frequency to 1 %."""
    model = BranchModel(small_bench.mesh, young=2e8, poisson=0.36, density=900.0, gravity=None)
    node = int(np.linalg.norm(model.mesh.nodes - small.skeleton.nodes[-1], axis=1).argmin())
    ours, theirs = bent_here(model, node, LOAD), bent_in_calculix(model, node, LOAD)
    assert np.linalg.norm(theirs.tip - ours.tip) < 0.01 * np.linalg.norm(ours.tip)
    assert theirs.frequency == pytest.approx(ours.frequency, rel=0.01)


def test_usd_holds_a_deformable_body_that_bends_as_we_do(small_bench, small, tmp_path):
    """Read back by USD: valid, right-handed; its mesh and modulus give our compliance."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdShade

    mesh = small_bench.mesh
    young = np.linspace(3e8, 1e8, mesh.tet_count)
    model = BranchModel(mesh, young=young, poisson=0.36, density=900.0, gravity=None)
    node = int(np.linalg.norm(mesh.nodes - small.skeleton.nodes[-1], axis=1).argmin())
    path = tmp_path / "a.usdc"
    write_usd(as_deformable(model, node), RayleighDamping(0.1, 2e-3), "b", path)
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1 and UsdGeom.GetStageUpAxis(stage) == "Z"
    body, solid = stage.GetDefaultPrim(), UsdGeom.TetMesh.Get(stage, "/Branch/simulation")
    # Schemas that USD itself does not know stand in the metadata alone.
    applied = [prim.GetMetadata("apiSchemas").GetAppliedItems() for prim in (body, solid.GetPrim())]
    assert "OmniPhysicsDeformableBodyAPI" in applied[0]
    assert {"OmniPhysicsVolumeDeformableSimAPI", "PhysicsCollisionAPI"} <= set(applied[1])
    points, tets = np.array(solid.GetPointsAttr().Get()), np.array(
        solid.GetTetVertexIndicesAttr().Get())
    assert UsdGeom.TetMesh.FindInvertedElements(solid, Usd.TimeCode.Default()) == []
    assert len(solid.GetSurfaceFaceVertexIndicesAttr().Get()) == 4 * len(mesh.surface_faces())
    own = np.array(solid.GetPrim().GetAttribute("limber:youngsModulus").Get())
    np.testing.assert_allclose(own, np.repeat(young, 8), rtol=1e-6)
    wood, _ = UsdShade.MaterialBindingAPI(body).ComputeBoundMaterial("physics")
    value = {name: wood.GetPrim().GetAttribute(f"omniphysics:{name}").Get()
             for name in ("youngsModulus", "poissonsRatio", "density")}
    held = np.array(stage.GetPrimAtPath("/Branch/base").GetAttribute(
        "omniphysics:vtxIndicesSrc0").Get())
    read = BranchModel(TetMesh(points.astype(float), tets), young=value["youngsModulus"],
                       poisson=value["poissonsRatio"], density=value["density"], gravity=None,
                       fixed=np.isin(np.arange(len(points)), held))
    assert read.total_mass == pytest.approx(model.total_mass, rel=1e-3)
    assert body.GetAttribute("omniphysics:mass").Get() == pytest.approx(model.total_mass, rel=1e-5)
    end = int(np.linalg.norm(points - mesh.nodes[node], axis=1).argmin())
    assert tip_compliance(read, end) == pytest.approx(tip_compliance(model, node), rel=1e-3)
    assert bent_here(read, end, 1e-3 * LOAD).frequency == pytest.approx(
        bent_here(model, node, 1e-3 * LOAD).frequency, rel=0.05)
