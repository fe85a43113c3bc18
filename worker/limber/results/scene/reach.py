"""The reach of the grasp in a scene: its hemisphere, and the energy field on a grid."""

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import read_arrays, require_shapes
from limber.results.scene.arrays import SceneData
from limber.results.scene.colours import colour_scale, colours_of
from limber.store import Branch
from limber.store.loading import load_skeleton

_GRID = 48
"""Points along the longest edge of the grid: a cell is then thinner than the trusted region, which
follows the shell that the branch yields along."""


def add_reach(data: SceneData, branch: Branch) -> None:
    """Add the hemisphere about the base that bounds the grasp's positions, and the energy there if
    it was sampled.
    """
    if branch.has("energy.npz"):
        _add_energy_grid(data, branch)
    elif "grasp" in data.arrays and "skeleton" in data.arrays:
        from limber.planning.field.grasp_model import Reach

        reach = Reach.of(load_skeleton(branch), data.arrays["grasp"][0])
        _add_hemisphere(data, reach.base, reach.arc_length)


def _add_energy_grid(data: SceneData, branch: Branch) -> None:
    """Add ``energy_grid`` [h, j, z] J and its colours, transparent where the field is not trusted.
    """
    from limber.planning.field.energy_field import EnergyField

    path = branch.path("energy.npz")
    content = read_arrays(path, "an energy field")
    if {"chart_base_m", "arc_length_m"} <= set(content):
        require_shapes(path, content, {"chart_base_m": (3,), "arc_length_m": ()},
                       "an energy field")
        _add_hemisphere(data, content["chart_base_m"], float(content["arc_length_m"]))
    try:
        field = EnergyField.read(path)
    except InputError as error:
        data.info["notes"].append(f"the energy field cannot be shown: {error}")
        return
    low, high = field.region.low, field.region.high
    counts = np.maximum(np.ceil((high - low) / (high - low).max() * _GRID).astype(int), 2)
    axes = [np.linspace(*ends) for ends in zip(low, high, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    trusted = field.region.contains(points)
    if not trusted.any():
        return
    energies = np.zeros(len(points))
    energies[trusted] = field.energy(points[trusted])
    scale = colour_scale(energies[trusted], "energy with the grasp there", "J", "inferno")
    colours = colours_of(energies, scale)
    colours[:, 3] = trusted
    data.arrays |= {"energy_grid": energies.reshape(counts).astype(np.float32),
                    "energy_grid_color": colours.reshape(*counts, 4).astype(np.float32)}
    data.info["energy_grid"] = {"low_m": low.tolist(), "high_m": high.tolist(), "scale": scale}


def _add_hemisphere(data: SceneData, base: np.ndarray, radius: float) -> None:
    data.info["hemisphere"] = {"centre_m": np.asarray(base).tolist(), "radius_m": radius,
                               "axis": [0.0, 0.0, 1.0]}
