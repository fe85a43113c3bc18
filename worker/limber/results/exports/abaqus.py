"""Abaqus and CalculiX input: the quadratic tetrahedra themselves, with sets and materials."""

import numpy as np

from limber.core.errors import InputError
from limber.mechanics.model import BranchModel
from limber.results.exports.rigid_links import require_elastic

_STEP = 0.005
"""Relative difference of moduli below which they share one material."""
_A_LINE = 12
_ELEMENTS = {"linear": "C3D4", "quadratic": "C3D10"}


def inp_text(model: BranchModel, name: str, tip: int, load: np.ndarray | None = None,
             mode_count: int = 3) -> str:
    """Return an input file: mesh, materials, the held base, a static step and a frequency step.

    The shape is that of the hanging branch, which already carries its weight. The steps therefore
    have no weight, and its geometric stiffness is left out. Attached masses are left out too.

    Args:
        model: Has quadratic tetrahedra. Their node order is that of Abaqus.
        name: Name of the model.
        tip: The loaded node, named TIP.
        load: Load on the tip node [N], shape [3]; None: no static step.
        mode_count: Number of frequencies; 0: no frequency step.

    Raises:
        InputError: *ELASTIC does not support the model's material, or Abaqus its element.
    """
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
    lines += _set("*NSET, NSET=BASE", np.flatnonzero(model.fixed) + 1)
    lines += _set("*NSET, NSET=TIP", np.array([tip + 1]))
    if "grasp" in mesh.point_data:
        lines += _set("*NSET, NSET=GRASP", np.flatnonzero(mesh.point_data["grasp"] > 0) + 1)
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
        lines += _set(f"*ELSET, ELSET=PART{number}", np.flatnonzero(own) + 1)
        lines += [f"*MATERIAL, NAME=WOOD{number}", "*ELASTIC", f"{young:.9g}, {poisson:.6g}",
                  "*DENSITY", f"{density:.9g}",
                  f"*SOLID SECTION, ELSET=PART{number}, MATERIAL=WOOD{number}"]
    return lines


def _set(head: str, numbers: np.ndarray) -> list[str]:
    return [head, *(", ".join(map(str, numbers[at:at + _A_LINE].tolist()))
                    for at in range(0, len(numbers), _A_LINE))]
