"""A graph in the 3D view's lower right corner: Young's modulus along the branch, energy, force.

The worker states all positions in the frame (``limber.results.scene.animation``); here it is drawn.
"""

import blf
import bpy
import gpu
from gpu_extras.batch import batch_for_shader

from ..branch import branches
from ..bridge import animation
from .view_borders import covered_width

NONE = "none"
GRAPHS = {"young": "Young's modulus along the branch", "energy": "Energy along the paths",
          "force": "Force of the pull"}
"""Graphs that a branch may have, by their name in the worker's data."""
_WIDTH, _HEIGHT = 230, 110
_LEFT, _BELOW, _ABOVE, _RIGHT = 62, 38, 42, 14
_MARGIN, _TEXT, _DOT = 18, 11, 3.0
_PAPER, _INK, _GRID = (0.09, 0.09, 0.10, 0.88), (0.92, 0.92, 0.92, 1.0), (1.0, 1.0, 1.0, 0.14)
_CURSOR = (1.0, 1.0, 1.0, 0.6)


def graphs_of(surface: bpy.types.Object | None) -> dict:
    """Return the graphs that a branch has, by name."""
    if surface is None:
        return {}
    return branches.info_of(surface).get("graphs") or {}


def strip(rows: list[list[float]]) -> tuple[list, list]:
    """Return corners and triangles of a band of rows ``[x, low, high]``."""
    corners = [corner for x, low, high in rows for corner in ((x, low), (x, high))]
    triangles = [triple for k in range(0, len(corners) - 2, 2)
                 for triple in ((k, k + 1, k + 2), (k + 1, k + 3, k + 2))]
    return corners, triangles


class _Frame:
    """The frame of a graph, in pixels: positions of fractions of its width and height."""

    def __init__(self, x: float, y: float, size: float):
        self.x, self.y, self.size = x, y, size
        self.shader = gpu.shader.from_builtin("UNIFORM_COLOR")

    def at(self, point) -> tuple[float, float]:
        return (self.x + point[0] * _WIDTH * self.size, self.y + point[1] * _HEIGHT * self.size)

    def draw(self, kind: str, points, color, triangles=None) -> None:
        places = [self.at(point) for point in points]
        # Text written before has reset it.
        gpu.state.blend_set("ALPHA")
        self.shader.bind()
        self.shader.uniform_float("color", color)
        batch_for_shader(self.shader, kind, {"pos": places}, indices=triangles).draw(self.shader)

    def box(self, left: float, below: float, right: float, above: float, color) -> None:
        """Fill a box; its corners in pixels from the frame's lower left corner, unscaled."""
        corners = [(left, below), (right, below), (right, above), (left, above)]
        self.draw("TRIS", [(x / _WIDTH, y / _HEIGHT) for x, y in corners], color,
                  [(0, 1, 2), (0, 2, 3)])

    def text(self, words: str, x: float, y: float, *, align: float = 0.0, color=_INK) -> float:
        """Write ``words`` [pixels from the corner, unscaled]; returns their width."""
        blf.size(0, _TEXT * self.size)
        blf.color(0, *color)
        width = blf.dimensions(0, words)[0]
        blf.position(0, self.x + x * self.size - align * width, self.y + y * self.size, 0)
        blf.draw(0, words)
        return width / self.size


def _draw() -> None:
    context = bpy.context
    settings = context.scene.limber
    surface = branches.find_surface(context.scene)
    if settings.graph == NONE or surface is None or not context.space_data.overlay.show_overlays:
        return
    graph = graphs_of(surface).get(settings.graph)
    if graph is None:
        return
    size = context.preferences.system.ui_scale
    right = context.region.width - covered_width(context, "UI") - (_MARGIN + _RIGHT + _WIDTH) * size
    frame = _Frame(right, (_MARGIN + _BELOW) * size, size)
    _draw_paper(frame, graph)
    _draw_content(frame, graph, cursor_of(settings.graph, surface, context.scene))
    gpu.state.blend_set("NONE")


def _draw_paper(frame: _Frame, graph: dict) -> None:
    frame.box(-_LEFT, -_BELOW, _WIDTH + _RIGHT, _HEIGHT + _ABOVE, _PAPER)
    for share, words in graph["x"]["ticks"]:
        frame.draw("LINES", [(share, 0.0), (share, 1.0)], _GRID)
        frame.text(words, share * _WIDTH, -15, align=0.5)
    for share, words in graph["y"]["ticks"]:
        frame.draw("LINES", [(0.0, share), (1.0, share)], _GRID)
        frame.text(words, -6, share * _HEIGHT - 4, align=1.0)
    frame.text(graph["x"]["title"], _WIDTH / 2, -32, align=0.5)
    frame.text(graph["title"], -_LEFT + 12, _HEIGHT + 26)


def _draw_content(frame: _Frame, graph: dict, cursor: float | None) -> None:
    for band in graph["bands"]:
        corners, triangles = strip(band["rows"])
        if triangles:
            frame.draw("TRIS", corners, (*band["color"], 0.28), triangles)
    for line in graph["lines"]:
        color = (*line["color"], 1.0)
        if line["is_dotted"]:
            for x, y in line["points"]:
                x, y = x * _WIDTH, y * _HEIGHT
                frame.box(x - _DOT, y - _DOT, x + _DOT, y + _DOT, color)
        else:
            gpu.state.line_width_set(2.0 * frame.size)
            frame.draw("LINE_STRIP", line["points"], color)
            gpu.state.line_width_set(1.0)
    if cursor is not None:
        frame.draw("LINES", [(cursor, 0.0), (cursor, 1.0)], _CURSOR)
    x = -_LEFT + 12.0
    for part in (*graph["lines"], *graph["bands"]):
        if part["label"]:
            x += 14 + frame.text(part["label"], x, _HEIGHT + 10, color=(*part["color"], 1.0))


def cursor_of(name: str, surface: bpy.types.Object, scene: bpy.types.Scene) -> float | None:
    """Return the position of the visible frame in a graph, None if the graph is of something else.
    """
    info = branches.info_of(surface)
    places = graphs_of(surface)[name].get("cursor") or []
    frames, observation = info.get("frames") or {}, info.get("observation") or {}
    is_of_frames = observation.get("is_shown", False) if name == "force" else (
        frames.get("name") == info.get("plan"))
    if not places or not is_of_frames or frames.get("count") != len(places):
        return None
    number = round(animation.cache_frame(surface, scene.frame_current))
    return places[min(max(number, 0), len(places) - 1)]


DRAWN = (_draw, "POST_PIXEL")
