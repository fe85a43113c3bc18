"""The content of a scene: the branch, what moves in it, paths, pulls and graphs.

The add-on computes nothing. Colours, tick labels and the view direction are therefore computed
here. One ``.npz`` file passes them to Blender's process: plain arrays (nothing pickled), and
``info``, a JSON text. Vertices are those of the mesh's surface in the order of the PC2 frames:
``mesh.surface_faces()`` compacted by ``numpy.unique``.

Arrays (m, s, J, Pa; missing parts of a folder are omitted):

==============================================  ====================================================
``vertices`` [v, 3], ``faces`` [f, 3]           the surface
``scalar:NAME`` [v], ``color:NAME`` [v, 4]      values at rest, or the worst of all frames, and
                                                linear colours; NAME in ``info["scalars"]``
``frame_scalar:NAME`` [frames, v]               the same in each frame; ``info["frame_scalars"]``
``frame_level:NAME`` [frames, v] bytes,         its colours: which of the palette that the scale's
``palette:COLOURS`` [256, 4]                    ``colours`` names
``frame_times``, ``frame_energy``,              one number a frame: ``info["frames"]`` says
``frame_kinetic_energy``, ``frame_min_det_f``,  ``rate_hz`` and whether the times are those of a
``frame_strain`` [frames]                       motion (``is_timed``) or one pose a frame
``cloud`` [c, 3], ``cloud_color`` [c, 4]        the aligned scan
``skeleton`` [n, 3], ``skeleton_parent``,       the centreline; flags: 1 root, 2 fork, 4 tip, 8
``skeleton_radius``, ``skeleton_radius_sigma``  radius limited, 16 interpolated, 32 unresolved, 64
``skeleton_order``, ``skeleton_probability``,   bridged, 128 edited; the probability that a node
``skeleton_flags`` [n]                          is there
``control_points`` [k, 3], ``grasp`` [1, 3],    marks at rest, the radii of the balls that mark them
``targets`` [t, 3]; each with ``_radius``       (``info["targets"]`` names the targets)
``control_points_motion`` [frames, k, 3],       where they are in each frame
``targets_motion``, ``grasp_motion`` [frames, 3]
``path:KEY`` [p, 3], ``path_pose:KEY`` [p, 6],  paths of ``info["paths"]``: points, poses, energy
``path_energy:KEY`` ``path_force:KEY``          (colours by ``info["path_energy"]``), force, strain
``path_strain:KEY`` [p], ``path_color:KEY``
``tree:KEY`` [q, 3], ``tree_parent:KEY`` [q]    search trees of ``info["trees"]``: nodes, and which
                                                earlier one each hangs on (-1: none)
``rods:NAME`` [u, 3], ``rod_faces:NAME``        thin rods in the colours of ``info["rods"]``:
[x, 3], ``rod_color:NAME`` [u, 4]               ``plan``, ``baseline`` by energy, ``skeleton`` as
                                                thick as it is, ``fit`` along simulated points
                                                with balls at measured ones
``energy_grid`` [h, j, z],                      the field's energy on the grid of
``energy_grid_color`` [h, j, z, 4]              ``info["energy_grid"]`` (``low_m``, ``high_m``,
                                                ``scale``); transparent where it is not trusted
``observation`` [t, m, 3], ``observation_       what was measured in the pull that
visible`` [t, m], ``observation_times`` [t],    ``info["observation"]`` names, and the gripper
``observation_grasp`` [g, 3], ``observation_
grasp_times`` [g]
``observation_motion`` [frames, m, 3],          the same points in each frame, where the frames
``observation_seen`` [frames, m]                are of that pull
``robot_starts``, ``robot_ends`` [frames, n,    rods with round ends: the arm of the plan's dry
3], ``robot_radii`` [n]                         run from foot to wrist, then the gripper, of which
                                                ``info["robot"]`` says the name and the last rods
``solid:KEY`` [u, 3], ``solid_faces:KEY``       surfaces of a cell, of which ``info["cell"]``
[x, 3]                                          says title, colour and opacity
``frame_bounds`` [2, 3], ``view_points``,       what the camera must see, and its direction
``view_direction`` [3]
==============================================  ====================================================

``info`` also has ``graphs`` (see below), ``goal`` and ``hemisphere``
(centre, radius, axis), ``base``, ``alignment`` (4x4, scan's file to branch), ``map_offset`` (the
branch's origin in the scan's coordinates, double precision), ``uuid`` and ``source``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from limber.core.errors import BranchFolderError, Command, InputError, Option
from limber.core.files.reading import read_arrays, require_shapes
from limber.core.files.tables import read_columns
from limber.estimation.estimate_file import read_estimate
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.loads.loaded_branch import NamedTarget
from limber.mechanics.materials.materials import STRENGTH_OVER_YOUNG, strength_of
from limber.planning.cost import arc_lengths
from limber.planning.plan_file import read_plan_summary
from limber.planning.search_files import read_trees
from limber.recordings.recording import Pull, PullEntry, read_pull
from limber.results.findings import PATH_NAMES, SAME, modulus_origin, remarks_on
from limber.results.motion_files import FramesFile, node_average, read_frames_file, read_pc2
from limber.results.scene.colours import (
    FORMAT,
    SceneData,
    add_rods,
    colour_scale,
    colours_of,
    levels_of,
    palette,
    with_unit,
)
from limber.results.scene.still_objects import (
    add_cloud,
    add_marks,
    add_reach,
    add_robot,
    add_scalar,
    add_skeleton,
    add_skeleton_rods,
    add_targets,
    add_view,
    alignment,
    map_offset,
)
from limber.store import Branch

# Graphs beside a branch: Young's modulus along it, energy along paths, the force of a pull.
#
# The viewer draws a graph in a frame. All positions are fractions of the frame's width and height
# from its lower left corner; ticks are labels. Lines are ``{"label", "color", "points",
# "is_dotted"}``, bands ``{"label", "color", "rows"}`` with rows ``[x, low, high]``; colours are
# sRGB. ``cursor`` has the position of each frame of the plan's or the pull's motion, if the graph
# shows one.

MEASURED, SIMULATED, TRUE = (0.25, 0.85, 0.95), (0.95, 0.95, 0.95), (1.0, 0.62, 0.30)
"""Colours as in the report (:data:`limber.core.constants.DATA_COLOURS`), for a dark background."""
FIRST, SECOND = (0.93, 0.36, 0.42), (0.45, 0.62, 1.0)
"""Colours of the planned path and of its baseline: as for the paths themselves
(:data:`limber.core.constants.PATH_COLOURS`), lighter for the graph's dark background."""
_MOST_POINTS = 400
_LOG_FROM = 5.0
"""Growth factor of a positive quantity above which its axis is logarithmic."""


@dataclass
class Axis:
    """An axis: its meaning, unit and range."""

    title: str
    unit: str
    low: float
    high: float
    log: bool = False

    @classmethod
    def over(cls, title: str, unit: str, values: Sequence[np.ndarray], *,
             log: bool = False) -> "Axis":
        """Return an axis over all values; it starts at zero unless there are negative values."""
        numbers = np.concatenate([np.ravel(part) for part in values]).astype(float)
        numbers = numbers[np.isfinite(numbers)]
        low, high = (float(numbers.min()), float(numbers.max())) if len(numbers) else (0.0, 1.0)
        if log and low > 0 and high > _LOG_FROM * low:
            return cls(title, unit, low / 1.15, high * 1.15, log=True)
        low = min(low, 0.0)
        return cls(title, unit, low, low + 1.06 * (high - low) if high > low else low + 1.0)

    def axis_fraction(self, values: float | np.ndarray) -> np.ndarray:
        """Return the positions of values, as fractions of the axis."""
        values = np.asarray(values, float)
        if self.log:
            values = np.log(np.maximum(values, 1e-300))
            return (values - np.log(self.low)) / np.log(self.high / self.low)
        return (values - self.low) / (self.high - self.low)

    def ticks(self) -> list[list[Any]]:
        """Return ``[fraction, label]`` of a few round values."""
        values = _decades(self.low, self.high) if self.log else _steps(self.low, self.high)
        largest = max((abs(value) for value in values), default=1.0)
        # On a logarithmic axis each tick has its own prefix.
        return [[float(self.axis_fraction(value)),
                 with_unit(value, self.unit, abs(value) if self.log else largest)]
                for value in values]


@dataclass
class Graph:
    """A graph under construction."""

    title: str
    x: Axis
    y: Axis
    cursor: np.ndarray = field(default_factory=lambda: np.empty(0))
    lines: list[dict[str, Any]] = field(default_factory=list)
    bands: list[dict[str, Any]] = field(default_factory=list)

    def line(self, label: str, color: tuple[float, float, float], x: np.ndarray, y: np.ndarray,
             *, is_dotted: bool = False) -> None:
        """Add a line, or single points; values that are not finite are omitted."""
        x, y = np.asarray(x, float), np.asarray(y, float)
        known = np.isfinite(x) & np.isfinite(y)
        chosen = np.flatnonzero(known)
        if len(chosen) > _MOST_POINTS:
            chosen = chosen[np.linspace(0, len(chosen) - 1, _MOST_POINTS).astype(int)]
        if len(chosen):
            points = np.column_stack([self.x.axis_fraction(x[chosen]),
                                      self.y.axis_fraction(y[chosen])])
            self.lines.append({"label": label, "color": color, "is_dotted": is_dotted,
                               "points": np.clip(points, 0.0, 1.0).round(4).tolist()})

    def band(self, label: str, color: tuple[float, float, float], x: np.ndarray, low: np.ndarray,
             high: np.ndarray) -> None:
        """Add a band between two lines."""
        rows = np.column_stack([self.x.axis_fraction(x), self.y.axis_fraction(low),
                                self.y.axis_fraction(high)])
        self.bands.append({"label": label, "color": color,
                           "rows": np.clip(rows, 0.0, 1.0).round(4).tolist()})

    def as_dict(self) -> dict[str, Any]:
        """Return the graph as the scene's file stores it."""
        return {"title": self.title, "lines": self.lines, "bands": self.bands,
                "cursor": self.x.axis_fraction(self.cursor).round(4).tolist(),
                **{name: {"title": axis.title, "ticks": axis.ticks()}
                   for name, axis in (("x", self.x), ("y", self.y))}}


def _steps(low: float, high: float) -> list[float]:
    """Return round values from ``low`` to ``high``, evenly spaced: three to seven."""
    step = 10.0 ** math.floor(math.log10((high - low) / 3))
    step *= max(factor for factor in (1.0, 2.0, 5.0) if 3 * factor * step <= high - low)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [step * number for number in range(first, last + 1)]


def _decades(low: float, high: float) -> list[float]:
    """Return 1, 2 and 5 of each power of ten from ``low`` to ``high``; above three decades only 1.
    """
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    factors = (1.0, 2.0, 5.0) if high < 1e3 * low else (1.0,)
    values = [factor * 10.0**power for power in powers for factor in factors]
    return [value for value in values if low <= value <= high]


def young_graph(estimate: dict[str, Any]) -> dict[str, Any]:
    """Return Young's modulus along the branch with its interval, and the truth if known, of the
    content of ``estimate.json``."""
    fractions = np.array(estimate["fractions"], float)
    young = np.array(estimate["young_pa"], float)
    interval = np.array(estimate["young_interval_pa"], float)
    if len(fractions) == 1:
        # One modulus for the whole branch.
        fractions, young, interval = np.array([0.0, 1.0]), np.repeat(young, 2), np.repeat(
            interval, 2, axis=0)
    # A modulus that is not determined has no interval; its line stays.
    is_known = np.isfinite(interval).all(axis=1)
    truth = estimate.get("truth") or {}
    true = np.array(truth.get("young_pa") or [], float)
    axis = Axis.over("Young's modulus", "Pa", [young, interval[is_known], true], log=True)
    graph = Graph("Young's modulus along the branch",
                  Axis("position on the main path (0 base, 1 tip)", "", 0.0, 1.0), axis)
    if is_known.sum() > 1:
        graph.band("95 %", SIMULATED, fractions[is_known], *interval[is_known].T)
    graph.line("estimated", SIMULATED, fractions, young)
    graph.line("", SIMULATED, fractions, young, is_dotted=True)
    if len(true) and len(true) == len(truth.get("fractions") or []):
        graph.line("assumed" if truth.get("assumed") else "true", TRUE, truth["fractions"], true,
                   is_dotted=True)
    return graph.as_dict()


def energy_graph(paths: dict[str, tuple[str, np.ndarray, np.ndarray]]) -> dict[str, Any]:
    """Return the energy along paths ``plan`` and ``baseline``: title, points [p, 3] m and energies
    [p] J."""
    along = {key: arc_lengths(points) for key, (_, points, _) in paths.items()}
    graph = Graph("Energy along the paths",
                  Axis.over("along the path", "m", list(along.values())),
                  Axis.over("energy", "J", [energy for _, _, energy in paths.values()]),
                  along.get("plan", np.empty(0)))
    for key, (title, _, energy) in paths.items():
        graph.line(title, FIRST if key == "plan" else SECOND, along[key], energy)
    return graph.as_dict()


def force_graph(name: str, times: np.ndarray, measured: np.ndarray,
                simulated: np.ndarray | None = None, cursor: np.ndarray | None = None,
                ) -> dict[str, Any] | None:
    """Return a pull's force [N], [n, 3], over times [s], measured (NaN where not) and simulated,
    with the time of each shown frame on the same clock [s] as cursor; None if it was not
    measured."""
    known = {"measured": measured, "simulated": simulated}
    forces = {label: np.linalg.norm(np.asarray(values, float).reshape(-1, 3), axis=1)
              for label, values in known.items() if values is not None}
    if not all(np.isfinite(force).any() for force in forces.values()):
        return None
    graph = Graph(f"Force of pull {name}", Axis.over("time", "s", [times]),
                  Axis.over("force", "N", list(forces.values())),
                  np.empty(0) if cursor is None else cursor)
    graph.line("measured", MEASURED, times, forces["measured"], is_dotted=True)
    if "simulated" in forces:
        graph.line("simulated", SIMULATED, times, forces["simulated"])
    return graph.as_dict()


_FRAME_SCALARS = {
    "strain_energy_density_j_m3": ("strain_energy", "strain energy density", "J/m³", "inferno"),
    "principal_strain": ("strain", "largest principal strain", "%", "inferno"),
    "principal_stress_pa": ("stress", "largest principal stress", "Pa", "inferno"),
    "det_f": ("det_f", "volume relative to the rest volume", "", "viridis")}
"""Arrays of ``frames/NAME.npz`` [frames, vertices]: name in the scene, title, unit, colours."""
_FRAME_VALUES = {"energies_j": "frame_energy", "kinetic_energies_j": "frame_kinetic_energy",
                 "min_det_f": "frame_min_det_f", "largest_principal_strains": "frame_strain"}
"""Lists of ``frames/NAME.json`` with one number per frame, and their arrays in the scene."""


def add_motion(data: SceneData, branch: Branch, plan: str | None, motion: str | None,
               strength: float | None = None) -> None:
    """Add the frames of ``motion``, by default the plan's, else the newest; ``strength``: breaking
    stress of the wood [Pa], else assumed. BranchFolderError if they do not exist or belong to
    another mesh."""
    names = [name.removesuffix(".pc2") for name in branch.names("frames") if name.endswith(".pc2")]
    data.info["motions"] = names
    if motion is not None and motion not in names:
        raise BranchFolderError(f"The branch has no frames named {motion!r}.",
                                f"Its frames are: {', '.join(names) or 'none'}.",
                                "Name one of them, or run ", Command("simulate"), ".")
    name = motion or (plan if plan in names else None)
    if name is None and plan is None and names:
        name = max(names, key=lambda each: _finished(branch, each))
    if name is None:
        return
    count = len(data.arrays["vertices"])
    positions, _, _ = read_pc2(branch.path(f"frames/{name}.pc2"))
    if positions.shape[1] != count:
        if motion is None and _is_of_an_earlier_mesh(branch, name):
            data.info["notes"].append(f"{name} belongs to an earlier mesh, so its motion is not "
                                      "shown")
            return
        raise BranchFolderError(
            f"frames/{name}.pc2 has {positions.shape[1]} vertices; the mesh's surface has "
            f"{count}.",
            "The frames belong to another mesh; Blender would silently show the rest shape.",
            "Run the stage that makes them again.")
    about = _about(branch, name, len(positions))
    _add_times(data, name, about, len(positions))
    data.arrays["frame_bounds"] = np.array(
        [bound(positions.reshape(-1, 3), axis=0) for bound in (np.min, np.max)], float)
    _add_values(data, branch, name, about, positions)
    _add_share_of_strength(data, strength)
    _add_carried(data, positions, name == plan)


def _finished(branch: Branch, name: str) -> str:
    """Return when frames were written, from the manifest: copying changes a file's own time."""
    return max((entry.finished for entry in branch.manifest.stages.values()
                if f"frames/{name}.pc2" in entry.writes), default="")


def _is_of_an_earlier_mesh(branch: Branch, name: str) -> bool:
    """Whether the mesh was made again after the frames were written."""
    stages = branch.manifest.stages
    meshed = max((stages[key].finished for key in ("reconstruct", "mesh") if key in stages),
                 default="")
    return _finished(branch, name) < meshed


def _about(branch: Branch, name: str, count: int) -> FramesFile:
    if not branch.has(f"frames/{name}.json"):
        return FramesFile(frame_count=count)
    path = branch.path(f"frames/{name}.json")
    about = read_frames_file(path)
    if about.frame_count not in (None, count):
        raise BranchFolderError(f"{path} describes {about.frame_count} frames, but there are "
                                f"{count}.", "The two files do not belong together.",
                                "Run the stage again.")
    return about


def _add_times(data: SceneData, name: str, about: FramesFile, count: int) -> None:
    """Add the time of each frame; a path without times plays one pose per frame."""
    times, rate = about.times_s, about.rate
    is_timed = times is not None
    data.arrays["frame_times"] = np.asarray(times, float) if is_timed else np.arange(count) / rate
    data.info["frames"] = {"name": name, "file": f"frames/{name}.pc2", "count": count,
                           "rate_hz": rate, "is_timed": is_timed}


def _add_values(data: SceneData, branch: Branch, name: str, about: FramesFile,
                positions: np.ndarray) -> None:
    count, vertex_count = positions.shape[:2]
    for key, array in _FRAME_VALUES.items():
        if (values := getattr(about, key)) is not None:
            data.arrays[array] = np.asarray(values, float)
    if not branch.has(f"frames/{name}.npz"):
        return
    path = branch.path(f"frames/{name}.npz")
    content = read_arrays(path, "the values of a motion's frames")
    for key, (scalar, title, unit, colours) in _FRAME_SCALARS.items():
        # Lists of another motion, or of a part of it, are left out.
        if key not in content or content[key].shape != (count, vertex_count):
            continue
        require_shapes(path, content, {key: (count, vertex_count)},
                       "the values of a motion's frames")
        add_frame_scalar(data, scalar, content[key], title, unit, colours)


def _add_share_of_strength(data: SceneData, strength: float | None) -> None:
    """Add each frame's ratio of stress to the breaking stress of the wood."""
    stress, young = data.arrays.get("frame_scalar:stress"), data.arrays.get("scalar:young")
    if stress is None or young is None:
        return
    source_text = (f"{100 * STRENGTH_OVER_YOUNG:g} % of E, assumed" if strength is None
                   else f"{strength / 1e6:.3g} MPa")
    add_frame_scalar(data, "stress_over_strength", stress / strength_of(young, strength),
                     f"stress over strength ({source_text})", "", "inferno", is_from_zero=True)


def add_frame_scalar(data: SceneData, name: str, values: np.ndarray, title: str, unit: str,
                     colours: str, *, is_from_zero: bool = False) -> None:
    """Add a value in each frame [frames, v], and the worst of all frames, on one scale."""
    values = values.astype(np.float32)
    worst, word = (values.min(axis=0), "least") if name == "det_f" else (values.max(axis=0), "peak")
    spanned = np.append(np.maximum(worst, 0.0), 0.0) if is_from_zero else worst
    scale = colour_scale(spanned, title, unit, colours)
    add_scalar(data, name, worst.astype(float), {**scale, "title": f"{word} {title}"})
    data.info["frame_scalars"][name] = scale
    data.arrays |= {f"frame_scalar:{name}": values, f"frame_level:{name}": levels_of(values, scale),
                    f"palette:{colours}": palette(colours)}


def _add_carried(data: SceneData, positions: np.ndarray, is_plan: bool) -> None:
    vertices = data.arrays["vertices"]
    for name in ("control_points", "grasp", "targets"):
        if len(data.arrays.get(name, ())):
            moved = carried(data.arrays[name], vertices, positions)
            data.arrays[f"{name}_motion"] = moved[:, 0] if name == "grasp" else moved
    if is_plan and "path:plan" in data.arrays:
        # The path is that of the gripper, which the grasp patch follows.
        data.arrays["grasp_motion"] = _along(data.arrays["path:plan"], len(positions))


def carried(points: np.ndarray, vertices: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return the motion of ``points`` inside the branch with the surface, [frames, k, 3], by
    inverse-distance weights of a high power: the ring of vertices around a point dominates, or both
    rings between two."""
    distance = np.linalg.norm(points[:, None] - vertices, axis=2)
    weights = np.maximum(distance, 1e-9) ** -4
    weights /= weights.sum(axis=1, keepdims=True)
    return points + np.einsum("kv,fvi->fki", weights, positions - vertices)


def _along(points: np.ndarray, count: int) -> np.ndarray:
    """Return a path's own points if it has ``count``, else points evenly spaced along it."""
    if len(points) == count:
        return points
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    distances = np.linspace(0.0, length[-1], count)
    return np.column_stack([np.interp(distances, length, points[:, axis]) for axis in range(3)])


# Measurements of a pull: points and gripper over time, on the moving branch.

RESIDUAL = "measured to simulated"
"""Title of the distance between observed and simulated position of a point."""


def add_observation(data: SceneData, branch: Branch) -> None:
    """Add the measurements of the shown motion's pull, else the newest's: ``observation`` [t, m, 3]
    m (the last one where ``observation_visible`` [t, m] is false) at ``observation_times`` [t] s,
    the gripper's ``observation_grasp`` [g, 3] m likewise on the same clock; ``info["pulls"]`` names
    all. If `limber simulate --pull` replays it, ``observation_motion`` [frames, m, 3] and
    ``observation_seen`` [frames, m] are in each frame, and scalar ``residual`` is the distance to
    the simulation."""
    pulls = [name for name in branch.names("pulls") if branch.has(f"pulls/{name}/pull.toml")]
    data.info["pulls"] = pulls
    frames = data.info.get("frames") or {}
    pull_name = frames.get("name")
    name = pull_name if pull_name in pulls else (pulls[-1] if pulls else None)
    if name is None:
        return
    try:
        pull = read_pull(branch.path(f"pulls/{name}"))
    except InputError as error:
        data.info["notes"].append(f"pull {name} cannot be shown: {error}")
        return
    is_shown = name == pull_name and frames["is_timed"]
    data.info["observation"] = {"pull": name, "is_shown": is_shown}
    data.arrays["observation_grasp"] = pull.poses[:, :3]
    data.arrays["observation_grasp_times"] = pull.times
    if (graph := force_graph(name, pull.times, pull.wrenches[:, :3],
                             cursor=times_of_frames(data, name))) is not None:
        data.info["graphs"]["force"] = graph
    seen = pull.observations
    if seen is not None and seen.visible.any():
        data.arrays["observation"] = _held_on(seen.positions, seen.visible)
        data.arrays["observation_visible"] = seen.visible
        data.arrays["observation_times"] = seen.times + pull.entry.time_offset_s
    if is_shown:
        _add_frames(data, branch, pull, seen.point_count if seen is not None else 0)


def times_of_frames(data: SceneData, pull: str) -> np.ndarray:
    """Return the time of each frame on the clock of a pull [s]; none if the frames are not its own.
    """
    about = data.info.get("observation") or {}
    if about.get("pull") != pull or not about["is_shown"]:
        return np.empty(0)
    times = data.arrays["frame_times"]
    # A replay starts at the gripper's first pose.
    return times - times[0] + data.arrays["observation_grasp_times"][0]


def _add_frames(data: SceneData, branch: Branch, pull: Pull, count: int) -> None:
    """Add the position of each point in each frame, and its distance to the simulation."""
    if "observation" not in data.arrays:
        return
    seen_at, seen = _in_frames(data, times_of_frames(data, pull.name))
    data.arrays |= {"observation_motion": seen_at, "observation_seen": seen}
    rest = _rest_points(data, pull.entry, count)
    if rest is None or not seen.any():
        return
    vertices = data.arrays["vertices"]
    positions, _, _ = read_pc2(branch.path(data.info["frames"]["file"]))
    distance = np.linalg.norm(seen_at - carried(rest, vertices, positions), axis=2)
    add_frame_scalar(data, "residual", _around(rest, distance, seen, vertices),
                     f"{RESIDUAL}, pull {pull.name}", "m", "inferno", is_from_zero=True)


def _rest_points(data: SceneData, entry: PullEntry, count: int) -> np.ndarray | None:
    """Return the rest positions of the observed points [m], shape [count, 3]; None if unknown."""
    rest = entry.rest_points_m
    found = np.array(rest, float) if rest is not None else data.arrays.get("control_points")
    return found if found is not None and found.shape == (count, 3) else None


def _in_frames(data: SceneData, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions at ``times`` [s], [frames, m, 3], linear between observations, and whether
    seen, [frames, m]: not where the nearest observation lacks the point, nor before the first and
    after the last."""
    found, visible, at = (data.arrays[f"observation{part}"] for part in ("", "_visible", "_times"))
    nearest = np.abs(times[:, None] - at).argmin(axis=1)
    step = np.diff(at).max(initial=0.0)
    is_inside = (times >= at[0] - step) & (times <= at[-1] + step)
    positions = np.empty((len(times), *found.shape[1:]))
    for point in range(found.shape[1]):
        known = visible[:, point]
        for axis in range(3):
            positions[:, point, axis] = (np.interp(times, at[known], found[known, point, axis])
                                         if known.any() else 0.0)
    return positions, visible[nearest] & is_inside[:, None]


def _around(points: np.ndarray, distance: np.ndarray, seen: np.ndarray, vertices: np.ndarray,
            ) -> np.ndarray:
    """Return distances [frames, m] at all vertices, by inverse squared distance; 0 if not observed.
    """
    weights = np.maximum(np.linalg.norm(vertices[:, None] - points, axis=2), 1e-9) ** -2
    total = seen @ weights.T
    values = np.where(seen, distance, 0.0) @ weights.T
    return np.divide(values, total, out=np.zeros_like(values), where=total > 0)


def _held_on(positions: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return positions; an unobserved one is replaced by the last, or else the first, observed one.
    """
    found = positions.copy()
    found[~visible] = 0.0
    for point in range(positions.shape[1]):
        seen = np.flatnonzero(visible[:, point])
        if len(seen):
            last = np.searchsorted(seen, np.arange(len(positions)), side="right") - 1
            found[:, point] = positions[seen[np.maximum(last, 0)], point]
    return found


# Measured against simulated: distances to the estimated branch during a pull.


def add_fit(data: SceneData, branch: Branch, name: str | None) -> None:
    """Add Young's modulus along the branch as a graph, and the fit to pull ``name``, else the
    estimate's first: ``rods:fit`` (lines along simulated points, balls at measured ones, coloured
    by the distance), scalar ``residual`` and graphs. InputError if ``estimate.json`` is damaged."""
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
        values = _mean_near(data.arrays["control_points"], mean, data.arrays["vertices"])
        add_scalar(data, "residual", values, colour_scale(values, RESIDUAL, "m", "inferno"))


def _mean_near(points: np.ndarray, values: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return values of a few points interpolated at all vertices, by inverse squared distance."""
    distance = np.linalg.norm(vertices[:, None] - points, axis=2)
    weights = np.maximum(distance, 1e-9) ** -2
    return (weights @ values) / weights.sum(axis=1)


# Paths to a goal in a scene: points, poses, energies, search trees and the goal.

_POSITION = ("x_m", "y_m", "z_m")
_TREES = {"D-RRT*": "plan", "RRT*": "baseline"}  # name of the path of each tree
_ROTATION = ("rx_rad", "ry_rad", "rz_rad")


def add_plan(data: SceneData, branch: Branch, plan: str | None) -> str | None:
    """Add the paths of ``plan``, by default the newest, and its goal; return its name.
    BranchFolderError if it does not exist or is damaged."""
    plans = [key.split(":", 1)[1] for key in branch.manifest.stages if key.startswith("plan:")]
    data.info["plans"] = plans
    if plan is None:
        if not plans:
            return None
        plan = max(plans, key=lambda name: branch.manifest.stages[f"plan:{name}"].finished)
    summary = read_plan_summary(branch.require(f"plans/{plan}.json", "plan", Option("name", plan)))
    for key, name in (("plan", plan), ("baseline", f"{plan}-baseline")):
        if not branch.has(f"plans/{name}.csv"):
            continue
        table = read_columns(branch.path(f"plans/{name}.csv"), _POSITION, "the table of a path")
        _add_path(data, key, table)
        data.info["paths"][key] = {"title": PATH_NAMES[key],
                                   "note": _path_note(summary.get(key) or {})}
    gap = (summary.get("certificate") or {}).get("gap_percent")
    if gap is not None and "plan" in data.info["paths"]:
        data.info["paths"]["plan"]["note"] += f", at most {gap:.1f} % above the least cost"
    _add_trees(data, branch, plan)
    _add_energy_scale(data)
    data.info["plan"] = plan
    data.info["goal"] = _goal(summary, data.arrays.get("path:plan"))
    saved, added = summary.get("energy_saved_percent"), summary.get("length_added_percent")
    if saved is not None and added is not None:
        data.info["notes"].append(
            "no shorter path was found" if max(abs(saved), abs(added)) < SAME else
            f"energy {round(-saved):+d} %, length {round(added):+d} % against the shortest path")
    if legs := summary.get("legs"):
        data.info["notes"].append("motion: " + ", ".join(
            f"{leg['name']} {leg['duration_s']:.0f} s" for leg in legs))
    if beyond := remarks_on(summary).get("peak_strain"):
        data.info["notes"].append(f"strain, {beyond}")
    return plan


def _add_path(data: SceneData, key: str, table: dict[str, np.ndarray]) -> None:
    positions = np.column_stack([table[name] for name in _POSITION])
    data.arrays[f"path:{key}"] = positions
    if all(name in table for name in _ROTATION):
        data.arrays[f"path_pose:{key}"] = np.column_stack(
            [positions, *(table[name] for name in _ROTATION)])
    for column, name in (("energy_j", "energy"), ("force_n", "force"), ("strain", "strain")):
        if column in table:
            data.arrays[f"path_{name}:{key}"] = table[column]


def _add_trees(data: SceneData, branch: Branch, plan: str) -> None:
    """Add the search trees; a user may have deleted their file, which is large."""
    data.info["trees"] = {}
    if not branch.has(f"plans/{plan}-trees.csv"):
        return
    trees = read_trees(branch.path(f"plans/{plan}-trees.csv"))
    for planner, key in _TREES.items():
        if planner in trees:
            data.arrays[f"tree:{key}"], data.arrays[f"tree_parent:{key}"] = trees[planner]
            data.info["trees"][key] = {"title": planner, "node_count": len(trees[planner][0])}


def _add_energy_scale(data: SceneData) -> None:
    """Colour all paths by energy on one scale, so that they can be compared."""
    energies = {key: data.arrays[f"path_energy:{key}"] for key in data.info["paths"]
                if f"path_energy:{key}" in data.arrays}
    if energies:
        scale = colour_scale(np.concatenate(list(energies.values())), "energy along the path",
                             "J", "inferno")
        data.info["path_energy"] = scale
        size = float(np.ptp(data.arrays["vertices"], axis=0).max())
        for key, values in energies.items():
            data.arrays[f"path_color:{key}"] = colours_of(values, scale)
            points = data.arrays[f"path:{key}"]
            along = np.arange(len(points) - 1)
            add_rods(data, key, f"{data.info['paths'][key]['title']} path by energy", points,
                     np.column_stack([along, along + 1]), 0.005 * size, values, scale)
        data.info["graphs"]["energy"] = energy_graph({
            key: (data.info["paths"][key]["title"], data.arrays[f"path:{key}"], values)
            for key, values in energies.items()})


def _path_note(summary: dict[str, Any]) -> str:
    parts = []
    if summary.get("length_m") is not None:
        parts.append(f"{100 * summary['length_m']:.1f} cm")
    if summary.get("energy_sum_nmm") is not None:
        total = summary["energy_sum_nmm"]
        parts.append(f"{total:.0f} N mm" if abs(total) >= 100 else f"{total:.3g} N mm")
    return ", ".join(parts)


def _goal(summary: dict[str, Any], path: np.ndarray | None) -> dict[str, Any] | None:
    """Return what must reach the goal region, its centre [m], and its radius [m] or None."""
    goal = summary.get("goal") or {}
    centre, radius = goal.get("position_m"), goal.get("tolerance_m")
    if centre is None:
        if path is None:
            return None
        centre = path[-1]
    return {"kind": goal.get("kind", "grasp"), "radius_m": radius,
            "centre_m": [float(value) for value in centre[:3]]}


# Content of a Blender scene of a branch folder: arrays ready for display, and their meaning.


def scene_data(branch: Branch, plan: str | None = None, motion: str | None = None,
               targets: Sequence[NamedTarget] = (), strength: float | None = None) -> SceneData:
    """Collect what can be shown of ``branch``: a plan's paths, by default the newest's, a motion's
    frames, by default the plan's, else the newest, named ``targets``; ``strength``: breaking stress
    of the wood [Pa], else assumed. BranchFolderError without mesh, plan or frames, or if these
    belong to another mesh."""
    mesh = TetMesh.read(branch.require("mesh.vtu", "reconstruct"))
    faces = mesh.surface_faces()
    used, compact = np.unique(faces, return_inverse=True)
    data = SceneData({"vertices": mesh.nodes[used], "faces": compact.reshape(-1, 3)})
    matrix = alignment(branch)
    data.info = {"format": FORMAT, "name": branch.name, "folder": str(branch.folder.resolve()),
                 "uuid": branch.uuid, "unit": "m", "scalars": {}, "frame_scalars": {}, "paths": {},
                 "rods": {}, "graphs": {},
                 "notes": [_size_note(branch, mesh)], "source": branch.manifest.source,
                 "alignment": matrix, "map_offset": map_offset(matrix)}
    if "young" in mesh.cell_data:
        young = (node_average(mesh) @ mesh.cell_data["young"])[used]
        title = f"Young's modulus ({modulus_origin(branch)})"
        add_scalar(data, "young", young, colour_scale(young, title, "Pa", "viridis"))
    add_cloud(data, branch)
    add_skeleton(data, branch)
    add_skeleton_rods(data)
    add_marks(data, mesh, used)
    add_targets(data, targets)
    plan = add_plan(data, branch, plan)
    add_reach(data, branch)
    add_motion(data, branch, plan, motion, strength)
    add_robot(data, branch, plan)
    add_observation(data, branch)
    add_fit(data, branch, (data.info.get("observation") or {}).get("pull"))
    add_view(data)
    data.arrays = {name: np.ascontiguousarray(array) for name, array in data.arrays.items()}
    return data


def _size_note(branch: Branch, mesh: TetMesh) -> str:
    length = (branch.made.result if branch.made else {}).get("length_m")
    extent = f"{length:.2f} m of centreline" if length else f"{np.ptp(mesh.nodes[:, 2]):.2f} m high"
    return f"{extent}, {mesh.tet_count} tetrahedra"
