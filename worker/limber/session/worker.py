"""Interactive session: a process that holds a branch and computes it for the current grasps.

Start it with ``limber session NAME.branch`` or ``python -m limber.session.worker NAME.branch``
(``--help``), or from Python with :class:`limber.session.client.InteractiveSession`. Any program can
use it; the other side does not need Limber.

Commands, one JSON object a line (UTF-8, at most 1 MiB) on standard input. Each may carry an ``id``
(an integer from 0). Its ``reply``, its ``error`` and the frame that answers it repeat the id:

- ``{"command": "hello", "protocol": 2}``: state the client's protocol. The reply is an
  error if it is not this one.
- ``{"command": "grasp", "vertex": 17, "mode": "point", "radius_m": 0.01}``: hold the branch there,
  where it is now; ``"point": [x, y, z]`` instead of a vertex is a position on the branch as it
  was scanned [m]. The reply contains ``grasp`` (a number), its ``pose``, and its ``rest_pose``
  on the branch as it was scanned. At most eight at once.
- ``{"command": "release", "grasp": 2}``: let go; without ``grasp``, of all.
- ``{"command": "move", "grasp": 2, "pose": [x, y, z, rx, ry, rz]}``: move that grasp (the first,
  if not named) to this pose [m, rad]. The newest pose wins: poses that arrive while one
  is being solved replace each other. It has no reply but its frame.
- ``{"command": "loads", "loads": [{"vertex": 17, "force_n": [0, 0, -1]}]}``: forces on the
  branch; they replace the earlier ones.
- ``{"command": "outdoors", "wind_m_s": [4, 0, 0], "snow_kg_m2": 0, "drag": 1.1, "fruit": [{"point":
  [x, y, z], "mass_kg": 0.2}], "cuts": [[x, y, z]]}``: wind, snow, fruit and cuts; they replace the
  earlier ones. Positions are on the scanned branch [m]. The reply contains ``added_mass_kg``,
  ``cut_mass_kg``, ``wind_force_n`` and ``gone``, the vertices that are cut off.
- ``{"command": "effects", "strain_limit": 0.01, "limit_load": true, "most": 50}``: their
  effects on the branch without grasps. The reply comes seconds later, between others, with the
  keys of `limber load`: ``sag_m``, ``greatest_strain``, ``strain_over_limit``, ``along``,
  ``frequencies_hz``, ``bears_times`` and ``held_by``, with intervals if there is an
  estimate. With ``"gust": 0.3`` (turbulence; ``gust_length_m``, ``gust_time_s``) or
  ``"gust_record": {"time_s": [...], "speed_m_s": [...]}`` the result is for the peak of the
  gusts, and ``gusts`` contains its parts.
- ``{"command": "gravity", "on": false}``: switch the weight of the branch on or off. With weight
  it has the scanned shape; without weight it rises from there.
- ``{"command": "young", "young_pa": [...]}``: Young's modulus at the control points; the
  rest shape remains the scanned one.
- ``{"command": "dynamics", "on": true}``: compute motion over time (about 60 steps a second, one
  as soon as a pose arrives) instead of equilibria. This needs the reduced model. The grasp
  follows at no more than two branch lengths a second.
- ``{"command": "status"}``: the reply states the grasps and the model that answers.
- ``{"command": "close"}``, or the end of the input: end.

Events, one JSON object a line on standard output; a client may leave them unread:

- ``{"event": "hello", "protocol": 2, "limber", "positions": PATH, "vertex_count", "control_count",
  "targets", "grasps", "rest_pose", "young_pa", "gravity_on", "extent_m"}``: frames are in the file
  PATH (limber.session.frame_buffer); the first shows the rest shape.
- ``{"event": "reply", "id", "command", ...}`` and ``{"event": "error", "id", "command",
  "message"}``: the answer to a command. An invalid command also gets an error and has no effect.
- ``{"event": "progress", "progress", "message"}``: a reduced model of the held branch is being
  learnt. Until then the full model answers, a few times a second, on the path to the target pose.
- ``{"event": "model", "size", "seconds", "snapshots", "refreshes", "from_cache"}``: a reduced model
  now answers. It needs exactly one grasp; with none or several, under loads and without weight,
  the full model answers.
- ``{"event": "check", "position_error", "energy_error", "good", "learned"}``: the reduced model was
  compared with the full one at a requested pose. If its error was too large, it has learned.
- ``{"event": "warning", "message"}``, ``{"event": "failed", "message"}`` (it did not start),
  ``{"event": "closed"}``.

The session ends within seconds after its client (its input ends, or its output cannot be read),
also during a computation. Its trainer (limber.session.trainer) ends with it.
"""

import argparse
import contextlib
import gc
import json
import os
import queue
import sys
import tempfile
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import Cancelled, InputError, LimberError
from limber.core.json_values import plain
from limber.core.processes import Pool
from limber.core.progress import Progress
from limber.mechanics.added_masses import PointMass
from limber.mechanics.loads.load_effects import (
    Gusts,
    Turbulence,
    WindRecord,
    blown,
    load_effects,
    with_peak,
)
from limber.mechanics.loads.outdoor import Outdoors
from limber.session import protocol
from limber.session.frame_buffer import FrameWriter
from limber.session.model_choice import Answering, Checked, Learnt
from limber.session.protocol import (
    LINE_LIMIT,
    Close,
    Effects,
    Lines,
    Move,
    NotUnderstood,
    SessionSettings,
    parse_command,
)
from limber.session.session_branch import Answer, HeldBranch, load_held
from limber.store import Branch
from limber.store.loading import known_damping
from limber.version import VERSION

# The effects of outdoor loads on the held branch, computed in a separate process.
#
# It takes seconds; the branch can be moved meanwhile. The answer is for the branch as stored in
# its folder, with the moduli and loads of the session at the time of the request.

# Writes a session's events in a thread: a client that does not read does not stop the frames.


class Events:
    """JSON lines on standard output, dropped if unread. ``gone``: called once the reader closed."""

    def __init__(self, gone: Callable[[], None] = lambda: None):
        self._gone = gone
        self._lines: queue.Queue[str | None] = queue.Queue(maxsize=_WAITING_LIMIT)
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()

    def say(self, **line: Any) -> None:
        """Write one event."""
        try:
            self._lines.put_nowait(json.dumps(plain(line), default=str))
        except queue.Full:
            return  # nobody reads it

    def close(self) -> None:
        """Report the end of the session, and write waiting events for at most a second."""
        self.say(event="closed")
        try:
            self._lines.put(None, timeout=1.0)
        except queue.Full:
            return
        self._thread.join(1.0)

    def _write(self) -> None:
        while (line := self._lines.get()) is not None:
            try:
                print(line, flush=True)
            except (OSError, ValueError):
                # Data that Python still buffers would fail again at exit.
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                self._gone()
                return


class EffectsTeller:
    """Answers one request at a time, to ``events``."""

    def __init__(self, folder: Path, settings: SessionSettings, events: Events):
        self._folder, self._settings, self._events = folder, settings, events
        self._pool: Pool | None = None
        self._asked: Future | None = None

    def ask(self, question: Effects, held: HeldBranch) -> None:
        """Compute the answer to a request; its ``reply`` or ``error`` follows. InputError if
        another is being answered, no load acts, the weight is off, or gusts come without a wind."""
        if self._asked is not None and not self._asked.done():
            raise InputError("The effects of loads are being computed.",
                             "One request is answered at a time.", "Wait for its reply.")
        loads, gusts = held.outdoors(), gusts_of(question)
        loads = replace(loads, wind=blown(loads.wind, gusts))
        # It remains for the next request: most of the time of the first is its start.
        self._pool = self._pool or Pool(1, name="the effects of loads")
        self._asked = self._pool.submit(effects_of, self._folder, self._settings, held.young,
                                        loads, gusts, question)
        self._asked.add_done_callback(partial(self.tell, question))

    def close(self) -> None:
        """Cancel the current request."""
        if self._pool is not None:
            self._pool.close()

    def tell(self, question: Effects, asked: Future) -> None:
        """Report the result of a request."""
        about: dict[str, Any] = {"id": question.id, "command": question.command}
        try:
            effects = asked.result()
        except (Cancelled, CancelledError):
            return
        except LimberError as error:
            self._events.say(event="error", **about, message=str(error))
        except Exception as error:
            # Like everything that a command triggers: the branch stays held.
            self._events.say(event="error", **about, message=f"{type(error).__name__}: {error}")
        else:
            self._events.say(event="reply", **about, **effects)


def gusts_of(question: Effects) -> Gusts | None:
    """Return the gusts of a request; InputError if its record is not one of a wind."""
    if question.gust_record is not None:
        return WindRecord.checked(np.array(question.gust_record.time_s),
                                  np.array(question.gust_record.speed_m_s), "gust_record")
    return None if question.gust is None else Turbulence(
        question.gust, question.gust_length_m, question.gust_time_s)


def effects_of(folder: Path, settings: SessionSettings, young: np.ndarray, loads: Outdoors,
               gusts: Gusts | None, question: Effects, progress: Progress) -> dict[str, Any]:
    """Return the effects of loads on a branch with the moduli ``young`` [K] [Pa] at its control
    points; LimberError if it cannot be loaded, or has no equilibrium."""
    held = load_held(folder, settings, progress)
    held.set_young(young)
    outdoors, peak = held.set_outdoors(loads), None
    if gusts is not None:
        outdoors, peak = with_peak(outdoors, gusts, known_damping(Branch.read(folder), progress))
    _, effects = load_effects(
        outdoors, strain_limit=question.strain_limit, deviation=held.young_deviation,
        most=question.most if question.limit_load else None, progress=progress)
    return effects | {"gusts": peak}


# The waiting commands, between the thread that reads the client and the one that solves.
#
# Commands keep their order, but a ``move`` replaces the one before it of the same grasp: of poses
# that arrive while one is being solved, the newest wins. The number of waiting commands is limited.

_WAITING_LIMIT = 1000
_PIECE_BYTES = 1 << 16


@dataclass(frozen=True)
class Received:
    """A command, or a message from the trainer, and its arrival time [s, monotonic]."""

    content: Any
    at: float


class Inbox:
    """A queue of commands; ``closed`` once the client has closed or disconnected."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[Received] = deque()
        self.closed = False
        self.last_at = 0.0

    def put(self, content: Any) -> bool:
        """Add an item; return False if too many are waiting already."""
        new = Received(content, time.monotonic())
        with self._changed:
            if not (isinstance(content, Move) and self._replaces(new)):
                if len(self._waiting) >= _WAITING_LIMIT:
                    return False
                self._waiting.append(new)
            self.last_at = new.at
            self._changed.notify_all()
        return True

    def close(self) -> None:
        """Report the end of the input."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def take(self, seconds: float) -> list[Received]:
        """Return all waiting messages; if there are none, wait for one up to the given time."""
        with self._changed:
            if not self._waiting and not self.closed and seconds > 0:
                self._changed.wait(seconds)
            found = list(self._waiting)
            self._waiting.clear()
            return found

    def _replaces(self, new: Received) -> bool:
        for number in range(len(self._waiting) - 1, -1, -1):
            before = self._waiting[number].content
            if not isinstance(before, Move):
                return False
            if before.grasp == new.content.grasp:
                self._waiting[number] = new
                return True
        return False


def read_commands(source: int, inbox: Inbox, refuse: Callable[[int, str], None]) -> None:
    """Put the commands of a file descriptor into an inbox until it ends; then close that.
    ``refuse`` gets an invalid command's id (0: it has none) and the reason."""
    lines = Lines()
    try:
        while not inbox.closed and (piece := os.read(source, _PIECE_BYTES)):
            for line in lines.feed(piece):
                _take(line, inbox, refuse)
    except OSError:
        pass  # the pipe is closed: end of input
    finally:
        # However this thread ends, a session without input must not run on.
        inbox.close()


def _take(line: bytes | None, inbox: Inbox, refuse: Callable[[int, str], None]) -> None:
    if line is None:
        refuse(0, f"Not understood: a line of more than {LINE_LIMIT} bytes; it was dropped.")
        return
    if not line.strip():
        return
    try:
        command = parse_command(line)
    except NotUnderstood as error:
        refuse(error.reply_id, str(error))
        return
    if isinstance(command, Close):
        inbox.close()
    elif not inbox.put(command):
        refuse(command.id, f"{_WAITING_LIMIT} commands are waiting, which is the limit. Send "
                           "fewer commands, or wait for replies.")


_SWITCH_SECONDS = 0.001
_LAST_SECONDS = 5.0
"""Time for a computation to continue after the client has disconnected."""


class Session:
    """Executes the client's commands, answers with frames; LimberError if the branch cannot be
    loaded."""

    def __init__(self, folder: Path, settings: SessionSettings):
        self.inbox = Inbox()
        self.events = Events(self.inbox.close)
        self.held = load_held(folder, settings, Progress(
            on_warning=lambda message: self.events.say(event="warning", message=message)))
        self.answering = Answering(folder, settings, self.held, self.inbox.put, self.events.say)
        self.effects = EffectsTeller(folder, settings, self.events)
        if settings.grasp:
            self.answering.hold_marked(settings.mode)
        path = settings.positions
        if path is None:
            handle, name = tempfile.mkstemp(prefix="limber-session-", suffix=".pos")
            os.close(handle)
            path = Path(name)
        self.frames = FrameWriter(path, self.held.faces, len(self.held.surface),
                                  len(self.held.loaded.targets))
        self._ended = threading.Event()
        self._asked = (0, time.monotonic())

    def run(self) -> None:
        """Answer until the client closes or disconnects."""
        _steady()
        self._publish(self.answering.rest())
        self.events.say(**self._hello())
        threading.Thread(target=self._read, daemon=True).start()
        self.answering.learn()
        try:
            while not self.inbox.closed:
                for received in self.inbox.take(self.answering.seconds_left(self.inbox.last_at)):
                    self._obey(received)
                self._answer()
        finally:
            self._ended.set()
            self.effects.close()
            self.answering.close()
            self.frames.close()
            self.events.close()

    def _read(self) -> None:
        read_commands(sys.stdin.fileno(), self.inbox, self._refuse)
        if not self._ended.wait(_LAST_SECONDS):
            # Still in one long solve, whose result is not needed any more.
            self.answering.close()
            with contextlib.suppress(OSError):
                self.frames.path.unlink()
            os._exit(0)

    def _refuse(self, command_id: int, message: str) -> None:
        self.events.say(event="error", id=command_id, command=None, message=message)

    def _obey(self, received: Received) -> None:
        command = received.content
        if isinstance(command, Learnt | Checked):
            self.answering.hear(command)
            return
        try:
            reply = self._act(command)
        except LimberError as error:
            self.events.say(event="error", id=command.id, command=command.command,
                            message=str(error))
            return
        except Exception as error:
            # Outermost handler of the process: whatever a command triggers, the branch stays held.
            traceback.print_exc()
            self.events.say(event="error", id=command.id, command=command.command,
                            message=f"{type(error).__name__}: {error}")
            return
        if not isinstance(command, protocol.Hello | protocol.Status | protocol.Effects):
            self._asked = (max(command.id, self._asked[0]), received.at)
        # Effects are reported when they are known.
        if not isinstance(command, protocol.Move | protocol.Effects):
            self.events.say(event="reply", id=command.id, command=command.command, **reply)

    def _act(self, command: protocol.Command) -> dict[str, Any]:
        answering = self.answering
        match command:
            case protocol.Move(grasp=grasp, pose=pose):
                answering.aim(grasp, np.array(pose))
            case protocol.Grab(vertex=vertex, point=point, radius_m=radius, mode=mode):
                number = answering.grab(vertex, point, radius, mode)
                return {"grasp": number, "pose": self.held.grasps[number].pose,
                        "rest_pose": self.held.grasps[number].grasp.rest_pose,
                        "node_count": len(self.held.grasps[number].grasp.nodes)}
            case protocol.Release(grasp=grasp):
                answering.release(grasp)
                return {"grasps": sorted(self.held.grasps)}
            case protocol.Gravity(on=on):
                answering.set_gravity(on)
            case protocol.Young(young_pa=young):
                answering.set_young(np.array(young))
            case protocol.Loads(loads=loads):
                answering.set_loads(loads)
            case protocol.Weather():
                made = answering.set_outdoors(_outdoors(command))
                return {"added_mass_kg": made.added_mass, "cut_mass_kg": made.cut_mass,
                        "wind_force_n": made.wind_force, "gone": self.held.vertices_gone()}
            case protocol.Effects():
                self.effects.ask(command, self.held)
            case protocol.Dynamics(on=on):
                answering.set_dynamics(on)
            case protocol.Status():
                return self._about()
            case protocol.Hello(protocol=number) if number != protocol.PROTOCOL:
                raise InputError(
                    f"The client speaks protocol {number}, this session {protocol.PROTOCOL}.",
                    "They belong to different versions of Limber.", "Install one version for both.")
        return {}

    def _answer(self) -> None:
        try:
            answer = self.answering.answer(self.inbox.last_at)
        except Exception as error:
            # As in _obey: an unexpected failure of a solver must not end the session.
            traceback.print_exc()
            self.answering.give_up()
            self.events.say(event="error", id=self._asked[0], command=None,
                            message=f"{type(error).__name__}: {error}")
            return
        if answer is not None:
            self._publish(answer)

    def _publish(self, answer: Answer) -> None:
        held = self.held
        strains, greatest, position = held.strain(answer)
        move_id, asked_at = self._asked
        numbers = {"strain_x_m": position[0], "strain_y_m": position[1], "strain_z_m": position[2]}
        if answer.grasps:
            first = answer.grasps[0]
            for name, vector, unit in (("force", first.force, "n"), ("torque", first.torque, "nm")):
                numbers |= {f"{name}_{axis}_{unit}": value
                            for axis, value in zip("xyz", vector, strict=True)}
        self.frames.publish(
            held.positions(answer), strains=strains, grasps=answer.grasps,
            targets=held.target_positions(answer), id=move_id,
            status=self.answering.status(answer), is_trusted=answer.is_trusted,
            is_converged=answer.is_converged, is_reached=answer.is_reached,
            is_reduced=answer.is_reduced, energy_j=answer.energy,
            kinetic_energy_j=answer.kinetic_energy, time_s=answer.time,
            greatest_strain=greatest, sag_m=held.sag(answer), gravity_on=held.gravity_on,
            min_det_f=held.model.internal(answer.displacement).min_det_f,
            delay_s=time.monotonic() - asked_at, **numbers)

    def _hello(self) -> dict[str, Any]:
        first = min(self.held.grasps, default=None)
        return {"event": "hello", "protocol": protocol.PROTOCOL, "limber": VERSION,
                "positions": str(self.frames.path), "vertex_count": len(self.held.surface),
                "control_count": len(self.held.young),
                "targets": [target.name for target in self.held.loaded.targets],
                "rest_pose": None if first is None else self.held.grasps[first].pose,
                "extent_m": self.held.model.extent, **self._about()}

    def _about(self) -> dict[str, Any]:
        grasps = [{"grasp": number, "mode": held.grasp.mode, "pose": held.pose,
                   "goal": held.goal} for number, held in self.held.grasps.items()]
        return {"grasps": grasps, "gravity_on": self.held.gravity_on, "young_pa": self.held.young,
                "dynamics_on": self.answering.is_moving, "learning": self.answering.is_learning}


def _outdoors(command: protocol.Weather) -> Outdoors:
    return Outdoors(command.wind_m_s, command.drag, command.snow_kg_m2, tuple(
        PointMass(one.point, one.mass_kg) for one in command.fruit), tuple(command.cuts))


def _steady() -> None:
    """Remove what would occasionally delay a frame: a waiting thread gets the interpreter within a
    millisecond, and garbage collection examines new objects only."""
    sys.setswitchinterval(_SWITCH_SECONDS)
    gc.collect()
    gc.freeze()


def run_session(folder: Path, settings: SessionSettings) -> int:
    """Run a session on standard input and output; return the exit code."""
    try:
        session = Session(folder, settings)
    except LimberError as error:
        print(json.dumps({"event": "failed", "message": str(error)}), flush=True)
        return error.exit_code
    session.run()
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Run ``python -m limber.session.worker FOLDER [--settings JSON]``."""
    parser = argparse.ArgumentParser(
        prog="python -m limber.session.worker", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the branch folder")
    parser.add_argument("--settings", default="{}", help="options of `limber session` as JSON")
    options = parser.parse_args(arguments)
    return run_session(options.folder, SessionSettings.model_validate_json(options.settings))


if __name__ == "__main__":
    sys.exit(main())
