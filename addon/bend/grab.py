"""Grab the branch at the mouse and bend it by hand, with the worker's answers in real time."""

import time
from pathlib import Path
from typing import ClassVar

import bpy
from bpy_extras import view3d_utils
from mathutils import Vector

from .. import preferences, properties
from ..branch import branches
from ..branch.needs_result import NeedsBranchInObjectMode, check_identity
from ..bridge import animation, meshes
from ..jobs.stages import stages
from ..jobs.worker import WorkerNotFound
from ..plan import goal_ball
from ..show.view_borders import write
from . import limits, live_loads, session
from .carried_marks import CarriedMarks
from .frame_rate import FrameRate
from .hold import Hold, Kept
from .lighter_view import LighterView
from .live_loads import LiveLoads
from .session import HeldFrame, Session

_INTERVAL_SECONDS = 1 / 120
"""Interval between two checks for a frame: the session makes up to 60 a second, and the average
delay is half of this.
"""
_KEYS = ("Drag: bend | F: add a fruit | C: cut here | Enter: keep for a simulation | S, G: keep "
         "as the plan's start, goal | Esc: release and exit")
_READY = "press on the branch and drag"
_LOADING = "The branch is being loaded | Esc: exit"
_PLACED = {"F": "fruit", "C": "cut"}
_PANEL_SECONDS = 0.2
_NAVIGATION = {"MIDDLEMOUSE", "WHEELUPMOUSE", "WHEELDOWNMOUSE", "WHEELINMOUSE", "WHEELOUTMOUSE",
               "TRACKPADPAN", "TRACKPADZOOM", "MOUSEROTATE", "MOUSESMARTZOOM", "NDOF_MOTION"}
_WORDS = {"learning": "full model, slow; learning", "reduced": "learnt model",
          "full": "full model", "untrusted": "NOT RELIABLE"}
_NORMAL, _OVER = (1.0, 1.0, 1.0, 1.0), (1.0, 0.25, 0.2, 1.0)


class LIMBER_OT_grab(NeedsBranchInObjectMode, bpy.types.Operator):
    """Bend the branch by hand: press on it and drag. Force and energy are shown at the mouse"""

    bl_idname = "limber.grab"
    bl_label = "Grab the Branch"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    radius: bpy.props.FloatProperty(
        name="Grasp Radius [m]", default=0.01, min=0.0, soft_max=0.1,
        description="The branch is held within this distance of the point under the mouse")

    _session: Session | None = None
    _surface: bpy.types.Object | None = None
    _hold: Hold | None = None
    _frame: HeldFrame | None = None

    def execute(self, context):
        self.report({"ERROR"}, "Grab the Branch needs the mouse in a 3D view. In a script, use "
                               "limber.session.client or limber.simulate.")
        return {"CANCELLED"}

    def invoke(self, context, event):
        if context.area is None or context.area.type != "VIEW_3D" or bpy.app.background:
            return self.execute(context)
        self._surface = branches.find_surface(context.scene)
        branch = branches.branch_of(self._surface)
        folder = Path(bpy.path.abspath(branch[branches.FOLDER_KEY]))
        try:
            check_identity(context.scene, folder)
            command = [*preferences.worker_command(), "session", "--no-grasp", str(folder)]
            self._session = Session(command, len(self._surface.data.vertices))
        except (OSError, ValueError, WorkerNotFound) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self._begin(context)
        if event.type == "LEFTMOUSE":
            # For the tool: a pressed button takes effect as soon as the branch is ready.
            self._waiting = (event.mouse_region_x, event.mouse_region_y)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        try:
            return self._modal(context, event)
        except ReferenceError:
            self._surface = None
            self._end(context)
            self.report({"ERROR"}, "The branch was removed, or another mesh of it was shown, while "
                                   "it was held.")
            return {"CANCELLED"}

    def cancel(self, context):
        """Blender closes or loads another file: the session must not continue unseen."""
        self._end(context)

    def _begin(self, context) -> None:
        mesh = self._surface.data
        self._loads = LiveLoads(context.scene, self._surface)
        self._tint, self._reached = limits.Tint(self._surface), []
        self._panel_drawn = 0.0
        self._rest = meshes.positions(mesh)
        self._marks = CarriedMarks(self._surface, self._rest)
        self._is_ready, self._waits_for, self._rate = False, "", FrameRate()
        self._lighter = LighterView(context.preferences)
        self._mouse = self._waiting = None
        motion = animation.motion_of(self._surface)
        self._had_motion = motion is not None and motion.show_viewport
        if self._had_motion:
            motion.show_viewport = False
        # The branch is at rest now, so are its marks; not only from the session's first frame on.
        self._marks.show(self._rest)
        self._area, self._region = context.area, context.region
        if self._region.type != "WINDOW":
            # Pressed in the sidebar: it refers to the view beside it.
            self._region = next(r for r in context.area.regions if r.type == "WINDOW")
        self._timer = context.window_manager.event_timer_add(_INTERVAL_SECONDS,
                                                             window=context.window)
        self._drawing = bpy.types.SpaceView3D.draw_handler_add(
            self._draw, (), "WINDOW", "POST_PIXEL")
        context.workspace.status_text_set(_LOADING)
        context.window_manager.modal_handler_add(self)

    def _modal(self, context, event):
        self._surface.name  # noqa: B018 (a ReferenceError here, not in the middle of something)
        if len(self._surface.data.vertices) != len(self._rest):
            self._show_motion()
            raise ReferenceError("another mesh")
        if event.type == "TIMER":
            return self._answered(context)
        if event.type in _NAVIGATION or event.type.startswith(("NUMPAD", "NDOF")):
            return {"PASS_THROUGH"}
        self._mouse = self._in_region(event)
        is_dragged = self._hold is not None and self._hold.is_dragged
        if event.type in {"LEFTMOUSE", "MOUSEMOVE"} and not is_dragged and not self._is_view(event):
            # Sidebar, toolbar and other editors stay usable.
            return {"PASS_THROUGH"}
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            self._waiting = self._mouse
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            self._waiting = None
            if self._hold is not None:
                self._hold.is_dragged = False
        elif event.type == "MOUSEMOVE" and is_dragged:
            self._drag()
            # At once: the next timer may be as far away as the answer.
            self._send()
        elif event.type in _PLACED and event.value == "PRESS":
            if (seen := self._seen(context, self._mouse)) is not None:
                self._loads.add(_PLACED[event.type], seen[0])
        elif event.type in {"ESC", "RIGHTMOUSE"} and event.value == "PRESS":
            self._end(context)
            return {"CANCELLED"}
        elif event.type in {"RET", "NUMPAD_ENTER", "S", "G"} and event.value == "PRESS":
            return self._keep(context, Kept("RET" if "ENTER" in event.type else event.type))
        # Not the whole area: its header and sidebars would be drawn again at each move.
        self._region.tag_redraw()
        return {"RUNNING_MODAL"}

    def _answered(self, context):
        """Read the session's messages, show its newest frame, send the next target."""
        self._lighter.turned()
        for told in self._session.poll():
            if self._loads.hear(told):
                if self._loads.error:
                    self.report({"WARNING"}, self._loads.error)
            elif self._hold is not None and told.get("id") == self._hold.asked:
                self._taken(told)
            elif told["event"] == "error":
                self.report({"WARNING"}, str(told.get("message", "")))
        if self._session.error:
            error = self._session.error
            self._end(context)
            self.report({"ERROR"}, error)
            return {"CANCELLED"}
        if not self._is_ready:
            self._wait(context)
        frame = self._session.frame(self._frame.sequence if self._frame else 0)
        if frame is not None:
            self._frame = frame
            self._rate.tick()
            meshes.set_positions(self._surface.data, frame.positions)
            self._marks.show(frame.positions)
            self._loads.tell(frame)
            self._show_limits(context, frame)
            self._region.tag_redraw()
            self._draw_panel()
            self._lighter.shown()
        self._loads.step(self._session)
        if self._waiting is not None and self._session.hello:
            self._take(context, self._waiting)
            self._waiting = None
        self._send()
        return {"RUNNING_MODAL"}

    def _wait(self, context) -> None:
        """State at the mouse and in the header what the session does before it can answer."""
        if self._session.hello:
            self._is_ready = True
            context.workspace.status_text_set(_KEYS)
        if (words := self._session.message or _READY) != self._waits_for:
            self._waits_for = words
            self._area.header_text_set(f"{words} ..." if words != _READY else words)
            self._region.tag_redraw()

    def _show_limits(self, context, frame: HeldFrame) -> None:
        """The branch is red while it is held beyond a limit of the plan."""
        self._reached = limits.reached(context.scene, frame)
        self._tint.show(self._hold is not None and any(one.share > 1.0 for one in self._reached))

    def _send(self) -> None:
        """Send the grasp's target, if it was not sent yet."""
        if self._hold is not None and self._hold.wanted is not None and self._hold.number:
            self._session.move(self._hold.number, tuple(self._hold.wanted))
            self._hold.wanted = None

    def _draw_panel(self) -> None:
        """Update the sidebar's numbers, a few times a second."""
        if time.monotonic() - self._panel_drawn > _PANEL_SECONDS:
            self._panel_drawn = time.monotonic()
            self._area.header_text_set(f"{self._rate.per_second()} frames/s, "
                                       f"{_WORDS[self._frame.who]}")
            next(r for r in self._area.regions if r.type == "UI").tag_redraw()

    def _take(self, context, mouse: tuple[int, int]) -> None:
        """Hold the branch at the mouse; a previous grasp is released."""
        seen = self._seen(context, mouse)
        if seen is None:
            return
        rest, place = seen
        if self._hold is not None:
            self._session.release()
        self._target = None
        self._hold = Hold(rest, place, self._session.grasp(tuple(rest), self.radius))

    def _seen(self, context, mouse: tuple[int, int]) -> tuple[Vector, Vector] | None:
        """Return the position under the mouse: on the branch as scanned, and in the world."""
        view = self._area.spaces.active.region_3d
        origin = view3d_utils.region_2d_to_origin_3d(self._region, view, mouse)
        direction = view3d_utils.region_2d_to_vector_3d(self._region, view, mouse)
        thing = self._surface.evaluated_get(context.evaluated_depsgraph_get())
        into = thing.matrix_world.inverted()
        hit, place, _, face = thing.ray_cast(into @ origin, into.to_3x3() @ direction)
        if not hit:
            return None
        mesh = thing.data
        nearest = min(mesh.polygons[face].vertices,
                      key=lambda k: (mesh.vertices[k].co - place).length)
        nearest = self._loads.vertex(nearest)
        return Vector(self._rest[nearest].tolist()), thing.matrix_world @ place

    def _taken(self, told: dict) -> None:
        if told["event"] == "error":
            self.report({"WARNING"}, str(told.get("message", "")))
            self._hold = None
            return
        self._hold.number = told["grasp"]
        self._hold.position = Vector(told["pose"][:3])
        self._hold.rest = Vector(told["rest_pose"][:3])
        if self._mouse is not None and self._hold.is_dragged:
            self._drag()

    def _drag(self) -> None:
        """Set the target to the mouse, in the view's plane through the grasp's first position."""
        hold = self._hold
        if hold.position is None:
            return
        view = self._area.spaces.active.region_3d
        now = view3d_utils.region_2d_to_location_3d(self._region, view, self._mouse, hold.begin)
        into = self._surface.matrix_world.inverted().to_3x3()
        hold.wanted = self._target = hold.position + into @ (now - hold.begin)

    def _keep(self, context, kept: Kept):
        hold = self._hold
        if hold is None and kept is Kept.MOTION and self._loads.acts:
            self._end(context, is_kept=True)
            self.report({"INFO"}, "The loads are kept in Material, Wind, Snow, Fruit, Cuts.")
            return {"FINISHED"}
        if hold is None or hold.position is None or self._target is None:
            self.report({"WARNING"}, "The branch is not bent yet. Press on the branch and drag.")
            return {"RUNNING_MODAL"}
        marked = self._surface.get(branches.GRASP_KEY)
        is_marked = marked is not None and (
            (Vector(marked[:3]) - hold.rest).length <= marked[3] + self.radius)
        if kept is not Kept.MOTION and not is_marked:
            self.report({"WARNING"}, "A plan moves the marked grasp. Bend the branch there, or "
                                     "press Enter to keep this grab for a simulation.")
            return {"RUNNING_MODAL"}
        target = tuple(self._target)
        self._end(context, is_kept=True)
        if kept is Kept.MOTION:
            moved = tuple(a - b for a, b in zip(target, hold.rest, strict=True))
            self._give(context, "simulate", grasp_point=tuple(hold.rest), move=moved)
            group = properties.group_of(context.scene, stages()["simulate"])
            group.grasp_radius, group.grasp_mode = self.radius, "point"
            self.report({"INFO"}, "Kept for Simulate a Motion in Material.")
        elif kept is Kept.START:
            self._give(context, "plan", start=target)
            self.report({"INFO"}, "Kept as the plan's start.")
        else:
            goal_ball.put(context.scene, self._surface, "goal", Vector(target))
            self.report({"INFO"}, "Kept as the plan's goal.")
        return {"FINISHED"}

    def _give(self, context, stage: str, **places: tuple[float, float, float]) -> None:
        group = properties.group_of(context.scene, stages()[stage])
        for name, place in places.items():
            setattr(group, name, place)
            setattr(group, properties.OPEN + name, True)

    _target: Vector | None = None

    def _end(self, context, *, is_kept: bool = False) -> None:
        """Release, and show the branch as before."""
        if self._session is None:
            return
        context.window_manager.event_timer_remove(self._timer)
        bpy.types.SpaceView3D.draw_handler_remove(self._drawing, "WINDOW")
        self._lighter.end()
        context.workspace.status_text_set(None)
        self._area.header_text_set(None)
        self._session.close()
        self._session = None
        if self._surface is not None:
            self._loads.end(is_kept=is_kept)
            self._tint.show(False)
            meshes.set_positions(self._surface.data, self._rest)
            self._marks.end()
            self._show_motion()
        self._area.tag_redraw()

    def _show_motion(self) -> None:
        motion = animation.motion_of(self._surface)
        if self._had_motion and motion is not None:
            motion.show_viewport = True

    def _in_region(self, event) -> tuple[int, int]:
        return event.mouse_x - self._region.x, event.mouse_y - self._region.y

    def _is_view(self, event) -> bool:
        """Whether the mouse is over the view itself: sidebar and toolbar overlap it."""
        def covers(region) -> bool:
            return (0 <= event.mouse_x - region.x < region.width
                    and 0 <= event.mouse_y - region.y < region.height)
        return covers(self._region) and not any(
            covers(region) for region in self._area.regions if region != self._region)

    def _draw(self) -> None:
        """Write at the mouse which forces hold the branch, and the model that answers."""
        if bpy.context.region != self._region:
            return
        lines, colour = self._lines()
        x, y = self._mouse or (20, 60)
        scale = bpy.context.preferences.system.ui_scale
        if (place := self._held_at()) is not None:
            limits.draw_ring(place, self._reached[0].share if self._reached else None, scale)
        write(lines, x + 18 * scale, y, 14 * scale, -18 * scale, colour)

    def _lines(self) -> tuple[list[str], tuple[float, float, float, float]]:
        if self._session is None or not self._session.hello:
            return [f"{self._waits_for or 'loading the branch'} ..."], _NORMAL
        if self._frame is None or self._hold is None:
            told = [] if self._frame is None or not self._loads.acts else live_loads.lines[:2]
            return [*told, _READY], _NORMAL
        force = Vector(self._frame.force).length
        words = _WORDS[self._frame.who]
        if self._frame.who == "learning" and self._session.message:
            words = f"full model, slow; {self._session.message}"
        told = [one.words for one in self._reached]
        lines = [f"{force:.3g} N   {1000 * self._frame.energy:.3g} mJ", words, *told]
        if self._frame.who == "untrusted":
            return lines, _OVER
        return lines, limits.colour_of(self._reached[0].share) if self._reached else _NORMAL

    def _held_at(self) -> tuple[float, float] | None:
        """Return the position of the grasp in the view [pixels]; None if none is held or seen."""
        hold = self._hold
        if hold is None or hold.position is None:
            return None
        place = self._surface.matrix_world @ (self._target or hold.position)
        seen = view3d_utils.location_3d_to_region_2d(
            self._region, self._area.spaces.active.region_3d, place)
        return None if seen is None else (seen.x, seen.y)


CLASSES = (LIMBER_OT_grab,)


def unregister() -> None:
    session.close_all()
