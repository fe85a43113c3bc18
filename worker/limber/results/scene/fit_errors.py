"""Measured against simulated: distances to the estimated branch during a pull."""

from typing import Any

import numpy as np

from limber.estimation.estimate_file import read_estimate
from limber.results.scene.arrays import SceneData
from limber.results.scene.colours import colour_scale
from limber.results.scene.graphs import force_graph, young_graph
from limber.results.scene.observation import RESIDUAL, times_of_frames
from limber.results.scene.rods import add_rods
from limber.results.scene.still_objects import add_scalar
from limber.store import Branch


def add_fit(data: SceneData, branch: Branch, name: str | None) -> None:
    """Add Young's modulus along the branch as a graph, and the fit of the simulation to a pull.

    Args:
        data: Gets ``rods:fit`` (lines along simulated points, balls at measured ones, coloured by
            the distance between them), scalar ``residual`` and graphs.
        branch: The branch whose ``estimate.json`` is read, if present.
        name: The pull whose measurement is shown; the first of the estimate if it is not one of
        them.

    Raises:
        InputError: ``estimate.json`` is damaged.
    """
    if not branch.has("estimate.json"):
        return
    estimate = read_estimate(branch.path("estimate.json"))
    data.info["graphs"]["young"] = young_graph(estimate)
    pulls = {pull["name"]: pull for pull in estimate["pulls"]}
    if not pulls:
        return
    pull = pulls.get(name) or next(iter(pulls.values()))
    if (force := force_graph(pull["name"], pull["all_times_s"], pull["measured_force_n"],
                             pull["simulated_force_n"],
                             times_of_frames(data, pull["name"]))) is not None:
        data.info["graphs"]["force"] = force
    _add_distances(data, pull)


def _add_distances(data: SceneData, pull: dict[str, Any]) -> None:
    measured, simulated = (np.array(pull[name], float) for name in ("observed_m", "simulated_m"))
    if measured.size == 0:
        return
    distance = np.linalg.norm(measured - simulated, axis=2)
    known = np.isfinite(distance)
    if not known.any():
        return
    scale = colour_scale(distance[known], f"{RESIDUAL}, pull {pull['name']}", "m", "inferno")
    size = float(np.ptp(data.arrays["vertices"], axis=0).max())
    # Simulated points of a moment are joined along the branch; measured ones are balls.
    number = np.cumsum(known).reshape(known.shape) - 1
    joined = known[:, :-1] & known[:, 1:]
    lines = np.column_stack([number[:, :-1][joined], number[:, 1:][joined]])
    add_rods(data, "fit", f"Measured over simulated, pull {pull['name']}",
             np.concatenate([simulated[known], measured[known]]), lines, 0.002 * size,
             np.tile(distance[known], 2), scale, ball_from=int(known.sum()),
             ball_radius=0.009 * size)
    seen = known.any(axis=0)
    if "residual" in data.info["frame_scalars"]:
        # The residual of each played frame is there already and says more.
        return
    if len(data.arrays.get("control_points", ())) == measured.shape[1] and seen.all():
        mean = np.sqrt((np.where(known, distance, 0.0)**2).sum(axis=0) / known.sum(axis=0))
        values = _around(data.arrays["control_points"], mean, data.arrays["vertices"])
        add_scalar(data, "residual", values, colour_scale(values, RESIDUAL, "m", "inferno"))


def _around(points: np.ndarray, values: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return values of a few points interpolated at all vertices, by inverse squared distance."""
    distance = np.linalg.norm(vertices[:, None] - points, axis=2)
    weights = np.maximum(distance, 1e-9) ** -2
    return (weights @ values) / weights.sum(axis=1)
