"""A branch as the volume itself: input of Abaqus and CalculiX, and USD."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from limber.core.errors import InputError
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.model import BranchModel
from limber.results.exports.rigid_links import require_elastic, tip_compliance

if TYPE_CHECKING:
    from pxr import Usd, Vt

# Abaqus and CalculiX input: the quadratic tetrahedra themselves, with sets and materials.

_STEP = 0.005
"""Relative difference of moduli below which they share one material."""
_A_LINE = 12
_ELEMENTS = {"linear": "C3D4", "quadratic": "C3D10"}


def inp_text(model: BranchModel, name: str, tip: int, load: np.ndarray | None = None,
             mode_count: int = 3) -> str:
    """Return an input file: mesh of quadratic tetrahedra, whose node order is Abaqus', materials,
    held base, a static step with ``load`` [N], shape [3], on the node TIP, and a frequency step,
    each if asked for. The hanging shape already carries its weight, so the steps have none, nor its
    geometric stiffness, nor attached masses. InputError if *ELASTIC does not support the material,
    or Abaqus the element."""
    require_elastic(model.material, "Abaqus' *ELASTIC", at_any_strain=True)
    mesh = model.mesh
    kind = _ELEMENTS.get(mesh.element.name)
    if kind is None:
        raise InputError(f"Abaqus files cannot hold the element {mesh.element.name!r}.",
                         "They take linear and quadratic tetrahedra.", "Use a mesh of those.")
    lines = ["*HEADING", f"{name}: branch by Limber, units m, kg, s, Pa. The shape is prestressed "
             "by gravity: apply no gravity.", "*NODE, NSET=ALL"]
    lines += [f"{number}, {x:.9g}, {y:.9g}, {z:.9g}"
              for number, (x, y, z) in enumerate(mesh.nodes.tolist(), start=1)]
    lines.append(f"*ELEMENT, TYPE={kind}, ELSET=BRANCH")
    for number, nodes in enumerate((mesh.tets + 1).tolist(), start=1):
        lines.append(", ".join(map(str, (number, *nodes))))
    lines += _set_lines("*NSET, NSET=BASE", np.flatnonzero(model.fixed) + 1)
    lines += _set_lines("*NSET, NSET=TIP", np.array([tip + 1]))
    if "grasp" in mesh.point_data:
        lines += _set_lines("*NSET, NSET=GRASP", np.flatnonzero(mesh.point_data["grasp"] > 0) + 1)
    lines += _materials(model)
    lines += ["*BOUNDARY", "BASE, 1, 3"]
    if load is not None:
        lines += ["*STEP", "*STATIC", "*CLOAD"]
        lines += [f"TIP, {axis + 1}, {value:.9g}" for axis, value in enumerate(load) if value]
        lines += ["*NODE PRINT, NSET=TIP", "U", "*NODE FILE", "U", "*EL FILE", "S", "*END STEP"]
    if mode_count:
        lines += ["*STEP", "*FREQUENCY", f"{mode_count}", "*NODE FILE", "U", "*END STEP"]
    return "\n".join(lines) + "\n"


def _materials(model: BranchModel) -> list[str]:
    """One material for each band of moduli, with the mean modulus of its tetrahedra."""
    values = np.column_stack([model.young, model.poisson, model.density])
    bands = np.column_stack([np.round(np.log(model.young) / _STEP),
                             np.round(model.poisson, 4), np.round(model.density, 3)])
    found, of = np.unique(bands, axis=0, return_inverse=True)
    of, lines = of.ravel(), []
    for number in range(len(found)):
        own = of == number
        young, poisson, density = values[own].mean(axis=0)
        lines += _set_lines(f"*ELSET, ELSET=PART{number}", np.flatnonzero(own) + 1)
        lines += [f"*MATERIAL, NAME=WOOD{number}", "*ELASTIC", f"{young:.9g}, {poisson:.6g}",
                  "*DENSITY", f"{density:.9g}",
                  f"*SOLID SECTION, ELSET=PART{number}, MATERIAL=WOOD{number}"]
    return lines


def _set_lines(head: str, numbers: np.ndarray) -> list[str]:
    return [head, *(", ".join(map(str, numbers[at:at + _A_LINE].tolist()))
                    for at in range(0, len(numbers), _A_LINE))]


# USD: the branch as a volume deformable body, for Isaac Sim and others that read USD physics.
#
# The schema is NVIDIA's ``OmniPhysics`` deformable schema, which is proposed for UsdPhysics (Omni
# Physics documentation, *Omni Physics Deformable Schema*). USD itself does not know its names yet,
# so they are written as applied schemas and attributes of those names.

_PARTS = np.array([[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3],
                   [4, 9, 5, 6], [4, 9, 6, 7], [4, 9, 7, 8], [4, 9, 8, 5]])
"""Nodes of a quadratic tetrahedron (VTK's order) in its eight linear ones."""
_FRICTION = 0.5
"""Friction coefficient of bark on a gripper. Assumed, not measured."""


@dataclass(frozen=True)
class Deformable:
    """A branch as simulators of deformable bodies represent it: linear tetrahedra without weight,
    with one modulus ``young`` [Pa] by which its tip is as compliant as the branch's, whose own are
    ``moduli``, shape [tet_count] [Pa]."""

    model: BranchModel
    moduli: np.ndarray
    young: float


def as_deformable(model: BranchModel, tip: int) -> Deformable:
    """Return a hanging branch with eight linear tetrahedra for each quadratic one, on the same
    nodes (fewer are far too stiff in bending), and the one modulus, as PhysX takes one material per
    body, that makes node ``tip`` as compliant. Where moduli vary along the branch, the bent shape
    differs. InputError if PhysX does not support the material."""
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
    """Write a USD file, text or binary by its suffix, in metres and kilograms, z up: ``/Branch`` is
    the body, ``/Branch/simulation`` its tetrahedra, ``/Branch/base`` fixes the base,
    ``/Branch/wood`` is its material; moduli and Rayleigh damping, for which the schema has no
    attribute, are ``limber:...``."""
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
    _set_attribute(body, kinds.Float, "omniphysics:mass", branch.model.total_mass)
    _set_attribute(body, kinds.Bool, "physxDeformableBody:disableGravity", True)
    _set_attribute(body, kinds.Float, "limber:rayleighMass", damping.mass)
    _set_attribute(body, kinds.Float, "limber:rayleighStiffness", damping.stiffness)
    _apply(prim, "OmniPhysicsVolumeDeformableSimAPI")
    _set_attribute(prim, kinds.Point3fArray, "omniphysics:restShapePoints", points)
    _set_attribute(prim, kinds.Int4Array, "omniphysics:restTetVtxIndices", tets)
    _set_attribute(prim, kinds.FloatArray, "limber:youngsModulus",
         Vt.FloatArray.FromNumpy(branch.moduli.astype(np.float32)))
    _hold(stage, np.flatnonzero(branch.model.fixed), points)
    wood = UsdShade.Material.Define(stage, "/Branch/wood")
    _apply(wood.GetPrim(), "OmniPhysicsBaseMaterialAPI", "OmniPhysicsDeformableMaterialAPI")
    for label, value in (("density", float(np.average(branch.model.density,
                                                      weights=mesh.volumes))),
                         ("dynamicFriction", _FRICTION), ("youngsModulus", branch.young),
                         ("poissonsRatio", float(np.mean(branch.model.poisson)))):
        _set_attribute(wood.GetPrim(), kinds.Float, f"omniphysics:{label}", value)
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
    _set_attribute(base, Sdf.ValueTypeNames.IntArray, "omniphysics:vtxIndicesSrc0",
         Vt.IntArray.FromNumpy(fixed.astype(np.int32)))
    _set_attribute(base, Sdf.ValueTypeNames.Point3fArray, "omniphysics:coordsSrc1",
         Vt.Vec3fArray([points[int(node)] for node in fixed]))


def _apply(prim: "Usd.Prim", *schemas: str) -> None:
    for schema in schemas:
        prim.AddAppliedSchema(schema)


def _set_attribute(prim: "Usd.Prim", kind: object, name: str, value: object) -> None:
    prim.CreateAttribute(name, kind, custom=name.startswith("limber:")).Set(value)
