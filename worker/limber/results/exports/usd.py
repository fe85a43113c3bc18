"""USD: the branch as a volume deformable body, for Isaac Sim and others that read USD physics.

The schema is NVIDIA's ``OmniPhysics`` deformable schema, which is proposed for UsdPhysics (Omni
Physics documentation, *Omni Physics Deformable Schema*). USD itself does not know its names yet, so
they are written as applied schemas and attributes of those names.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.model import BranchModel
from limber.results.exports.rigid_links import require_elastic, tip_compliance

if TYPE_CHECKING:
    from pxr import Usd, Vt

_PARTS = np.array([[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3],
                   [4, 9, 5, 6], [4, 9, 6, 7], [4, 9, 7, 8], [4, 9, 8, 5]])
"""Nodes of a quadratic tetrahedron (VTK's order) in its eight linear ones."""
_FRICTION = 0.5
"""Friction coefficient of bark on a gripper. Assumed, not measured."""


@dataclass(frozen=True)
class Deformable:
    """A branch as simulators of deformable bodies represent it: linear tetrahedra of one material.

    Attributes:
        model: Linear tetrahedra without weight and with one modulus throughout [Pa].
        moduli: Moduli of the branch itself, shape [tet_count] [Pa].
        young: Modulus of the model, with which its tip is as compliant as that of the branch.
    """

    model: BranchModel
    moduli: np.ndarray
    young: float


def as_deformable(model: BranchModel, tip: int) -> Deformable:
    """Return a branch with linear tetrahedra and the modulus that makes its tip as compliant.

    Each quadratic tetrahedron becomes eight linear ones on the same nodes; fewer linear ones are
    far too stiff in bending. PhysX takes one material per body. The one modulus accounts for this
    and for the remaining excess stiffness. Where the moduli vary along the branch, the bent shape
    differs from that of the branch.

    Args:
        model: Model of the hanging branch. Its shape includes the effect of weight, so none acts on
        it here.
        tip: Node at which the two are compared.

    Raises:
        InputError: PhysX does not support the material.
    """
    require_elastic(model.material, "PhysX")
    bare = model.without_point_masses().with_parameters(gravity=(0.0, 0.0, 0.0))
    parts = _PARTS if bare.mesh.is_quadratic else np.array([[0, 1, 2, 3]])
    linear = replace(bare.mesh, tets=bare.mesh.tets[:, parts].reshape(-1, 4),
                     cell_data={}).oriented()
    each = len(parts)
    first = float(np.mean(model.young))
    density = np.repeat(np.broadcast_to(model.density, model.mesh.tet_count), each)
    made = BranchModel(linear, young=first, density=density, gravity=None, fixed=bare.fixed,
                       poisson=float(np.mean(model.poisson)))
    young = first * tip_compliance(made, tip) / tip_compliance(bare, tip)
    return Deformable(made.with_young(young), np.repeat(model.young, each), young)


def write_usd(branch: Deformable, damping: RayleighDamping, name: str, path: Path) -> None:
    """Write a USD file, text or binary depending on its suffix: metres, kilograms, z up.

    ``/Branch`` is the body, ``/Branch/simulation`` its tetrahedra, ``/Branch/base`` fixes the
    vertices of the base, ``/Branch/wood`` is its material. Values without an attribute in the
    schema are written as ``limber:...``: the moduli of the tetrahedra and Rayleigh damping.
    """
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

    mesh = branch.model.mesh
    stage = Usd.Stage.CreateInMemory()
    stage.SetMetadata("comment", f"{name}: branch by Limber. Its shape is prestressed by gravity, "
                      "so no gravity acts on it.")
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    body = UsdGeom.Xform.Define(stage, "/Branch").GetPrim()
    stage.SetDefaultPrim(body)
    points = Vt.Vec3fArray.FromNumpy(mesh.nodes.astype(np.float32))
    tets = Vt.Vec4iArray.FromNumpy(np.ascontiguousarray(mesh.tets, np.int32))
    solid = UsdGeom.TetMesh.Define(stage, "/Branch/simulation")
    solid.CreatePointsAttr(points)
    solid.CreateTetVertexIndicesAttr(tets)
    solid.CreateSurfaceFaceVertexIndicesAttr(
        UsdGeom.TetMesh.ComputeSurfaceFaces(solid, Usd.TimeCode.Default()))
    solid.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    solid.CreateDisplayColorAttr([Gf.Vec3f(0.45, 0.33, 0.22)])
    prim = solid.GetPrim()
    UsdPhysics.CollisionAPI.Apply(prim)
    kinds = Sdf.ValueTypeNames
    _apply(body, "OmniPhysicsDeformableBodyAPI", "PhysxBaseDeformableBodyAPI")
    _set(body, kinds.Float, "omniphysics:mass", branch.model.total_mass)
    _set(body, kinds.Bool, "physxDeformableBody:disableGravity", True)
    _set(body, kinds.Float, "limber:rayleighMass", damping.mass)
    _set(body, kinds.Float, "limber:rayleighStiffness", damping.stiffness)
    _apply(prim, "OmniPhysicsVolumeDeformableSimAPI")
    _set(prim, kinds.Point3fArray, "omniphysics:restShapePoints", points)
    _set(prim, kinds.Int4Array, "omniphysics:restTetVtxIndices", tets)
    _set(prim, kinds.FloatArray, "limber:youngsModulus",
         Vt.FloatArray.FromNumpy(branch.moduli.astype(np.float32)))
    _hold(stage, np.flatnonzero(branch.model.fixed), points)
    wood = UsdShade.Material.Define(stage, "/Branch/wood")
    _apply(wood.GetPrim(), "OmniPhysicsBaseMaterialAPI", "OmniPhysicsDeformableMaterialAPI")
    for label, value in (("density", float(np.average(branch.model.density,
                                                      weights=mesh.volumes))),
                         ("dynamicFriction", _FRICTION), ("youngsModulus", branch.young),
                         ("poissonsRatio", float(np.mean(branch.model.poisson)))):
        _set(wood.GetPrim(), kinds.Float, f"omniphysics:{label}", value)
    UsdShade.MaterialBindingAPI.Apply(body).Bind(
        wood, UsdShade.Tokens.weakerThanDescendants, "physics")
    stage.GetRootLayer().Export(str(path))


def _hold(stage: "Usd.Stage", fixed: np.ndarray, points: "Vt.Vec3fArray") -> None:
    """Attach the vertices of the base to a fixed frame."""
    from pxr import Sdf, UsdGeom, Vt

    UsdGeom.Xform.Define(stage, "/Branch/ground")
    base = stage.DefinePrim("/Branch/base", "OmniPhysicsVtxXformAttachment")
    base.CreateRelationship("omniphysics:src0", False).SetTargets(["/Branch/simulation"])
    base.CreateRelationship("omniphysics:src1", False).SetTargets(["/Branch/ground"])
    _set(base, Sdf.ValueTypeNames.IntArray, "omniphysics:vtxIndicesSrc0",
         Vt.IntArray.FromNumpy(fixed.astype(np.int32)))
    _set(base, Sdf.ValueTypeNames.Point3fArray, "omniphysics:coordsSrc1",
         Vt.Vec3fArray([points[int(node)] for node in fixed]))


def _apply(prim: "Usd.Prim", *schemas: str) -> None:
    for schema in schemas:
        prim.AddAppliedSchema(schema)


def _set(prim: "Usd.Prim", kind: object, name: str, value: object) -> None:
    prim.CreateAttribute(name, kind, custom=name.startswith("limber:")).Set(value)
