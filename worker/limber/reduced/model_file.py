"""A reduced model as a file of plain arrays."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import read_arrays
from limber.mechanics.grasp import Grasp
from limber.mechanics.materials.materials import RayleighDamping
from limber.reduced.basis import Basis
from limber.reduced.reduced_model import ReducedModel
from limber.reduced.strain_polynomial import StrainPolynomial

FORMAT = 4


def write_model(model: ReducedModel, path: Path,
                beside: Mapping[str, np.ndarray] | None = None) -> None:
    """Write a model as plain arrays (npz, nothing pickled); ``beside`` goes into the file
    too, under names that begin with ``snapshot_``, which :func:`read_model` leaves alone."""
    arrays = {
        "format": FORMAT, "grasp_nodes": model.grasp.nodes, "grasp_weights": model.grasp.weights,
        "grasp_centre": model.grasp.centre, "grasp_mode": model.grasp.mode, "rest": model.rest,
        "columns": model.basis.columns, "lift_count": model.basis.lift_count,
        "states": model.basis.states, "captured": model.basis.captured, "reach": model.basis.reach,
        **{f"polynomial_{k}": v for k, v in vars(model.polynomial).items()},
        "load": model.load, "weight_stiffness": model.weight_stiffness, "mass": model.mass,
        "damping": [model.damping.mass, model.damping.stiffness],
        "control_young": model.control_young, "poses": model.poses,
        "training_young": model.training_young, "energies": model.energies,
        "young_spread": model.young_spread, "extent": model.extent,
        "error_names": list(model.error), "error_values": list(model.error.values())}
    if model.strain_fields is not None:
        arrays["strain_fields"] = model.strain_fields
    with open(path, "wb") as stream:
        np.savez(stream, **arrays, **(beside or {}))


def read_model(path: Path) -> ReducedModel:
    """Read a model that :func:`write_model` wrote.

    Raises:
        InputError: it is not one, or of another format.
    """
    arrays = {name: values for name, values in read_arrays(path, "a reduced model").items()
              if not name.startswith("snapshot_")}
    if int(arrays.get("format", -1)) != FORMAT:
        raise InputError(f"{path} has a different format.", "", "Build it again.")
    grasp = Grasp(arrays["grasp_nodes"], arrays["grasp_weights"], arrays["grasp_centre"],
                  "point" if str(arrays["grasp_mode"]) == "point" else "rigid")
    basis = Basis(arrays["columns"], int(arrays["lift_count"]), arrays["states"],
                  float(arrays["captured"]), arrays["reach"])
    linear, quadratic, by_lambda, by_mu = (
        arrays[f"polynomial_{name}"] for name in ("linear", "quadratic", "by_lambda", "by_mu"))
    polynomial = StrainPolynomial(linear, quadratic, by_lambda, by_mu,
                                  float(arrays["polynomial_poisson"]))
    error = dict(zip(arrays["error_names"].tolist(), arrays["error_values"].tolist(),
                     strict=True))
    return ReducedModel(
        grasp, arrays["rest"], basis, polynomial, arrays["load"], arrays["weight_stiffness"],
        arrays["mass"], RayleighDamping(*arrays["damping"]), arrays["control_young"],
        arrays["poses"], arrays["training_young"], arrays["energies"],
        float(arrays["young_spread"]), float(arrays["extent"]), error,
        strain_fields=arrays.get("strain_fields"))
