"""Graphs beside a branch: Young's modulus along it, energy along paths, the force of a pull.

The viewer draws a graph in a frame. All positions are fractions of the frame's width and height
from its lower left corner; ticks are labels. Lines are ``{"label", "color", "points",
"is_dotted"}``, bands ``{"label", "color", "rows"}`` with rows ``[x, low, high]``; colours are sRGB.
``cursor`` has the position of each frame of the plan's or the pull's motion, if the graph shows
one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from limber.planning.cost import arc_lengths
from limber.results.scene.colours import with_unit

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
