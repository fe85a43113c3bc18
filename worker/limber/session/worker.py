"""Interactive session: a process that holds a branch and answers "grasp at this pose now".

Start it with ``python -m limber.session.worker NAME.branch [--mode pinned] ...`` (``--help``),
or from Python with :class:`limber.session.client.InteractiveSession`. Any program can
talk to it; nothing of Limber is needed on the other side.

Commands, one JSON object a line on standard input:

- ``{"command": "move", "id": 7, "pose": [x, y, z, rx, ry, rz]}``: grasp at this pose [m, rad]. The
  newest pose wins: poses that come while one is being solved replace each other.
- ``{"command": "young", "young_pa": [...]}``: Young's modulus at the control points.
- ``{"command": "dynamics", "on": true}``: let the branch move in time (about 60 steps a second, one
  as soon as a pose comes) instead of answering with equilibria. Needs the reduced model. The grasp
  follows at two lengths of the branch a second at most.
- ``{"command": "close"}``, or the end of the input: end.

Events, one JSON object a line on standard output; a client may leave them unread:

- ``{"event": "hello", "protocol": 1, "positions": PATH, "vertex_count", "control_count",
  "rest_pose", "young_pa"}``: frames are in the file PATH (limber.session.frames).
- ``{"event": "progress", "progress", "message"}``: the reduced model is being made. Meanwhile the
  full model answers, a few times a second, on the way to the wanted pose.
- ``{"event": "model", "size", "seconds", "snapshots", "refreshes"}``: a reduced model took over.
- ``{"event": "check", "position_error", "energy_error", "good", "learned"}``: the reduced model was
  compared with the full one at a pose that was asked; where it was off it has learned.
- ``{"event": "warning", "message"}``, ``{"event": "error", "message"}``, ``{"event": "closed"}``.

The session ends when its client goes, and its trainer (limber.session.trainer) when it
goes itself: each sees its input end.
"""

import argparse
import gc
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from limber.errors import InputError, LimberError
from limber.mechanics.dynamics.simulate import NewmarkSettings
from limber.mechanics.grasp import check_pose, pose_between
from limber.mechanics.reduced.dynamics import ReducedStepper
from limber.mechanics.reduced.model import (
    ReducedModel,
    ReducedState,
    ReducedStaticSettings,
    as_control_points,
)
from limber.mechanics.reduced.strain import compile_kernels
from limber.mechanics.statics.solve import solve_static
from limber.session.frames import FrameWriter
from limber.session.trainer import load_branch, session_arguments
from limber.threads import one_thread

PROTOCOL = 1
RATE = 60.0
"""Steps a second in dynamics."""
_FULL_STEP = 0.05
"""Longest way to the wanted pose that the full model goes before it shows a frame, as part of the
branch's extent."""
_FASTEST = 2.0
"""Fastest that the gripper moves in dynamics, in extents of the branch a second."""
_SOONEST, _LATEST = 0.6, 1.4
"""Bounds of a step's length in dynamics, as parts of 1 / RATE."""
_STREAM_SECONDS = 0.1
_CHECK_INTERVAL = 1.0
_SWITCH_SECONDS = 0.001
_LIVE = NewmarkSettings(beta=0.3025, gamma=0.6, max_iterations=10)
"""Damps what is too quick for the step: poses of a mouse come in jumps."""
_QUICK = ReducedStaticSettings(max_iterations=12, max_halvings=2, start_count=2)


class _Wishes:
    """What the client wants now; written by the reading thread."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.pose: np.ndarray | None = None
        self.move_id = 0
        self.received = 0.0
        self.young: np.ndarray | None = None
        self.dynamics = False
        self.closed = False
        self.model: ReducedModel | None = None
        self.surface_columns = np.empty((0, 0))
        self.model_event: dict[str, Any] = {}

    def __call__(self, **values: Any) -> None:
        with self.changed:
            for name, value in values.items():
                setattr(self, name, value)
            self.changed.notify_all()


class _Events:
    """Writes events in a thread of its own: a client that does not read must not stop frames."""

    def __init__(self) -> None:
        self._lines: queue.Queue[str | None] = queue.Queue(maxsize=1000)
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()

    def say(self, **line: Any) -> None:
        try:
            self._lines.put_nowait(json.dumps(line, default=float))
        except queue.Full:
            return  # nobody reads

    def close(self) -> None:
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
            except (BrokenPipeError, OSError, ValueError):
                return  # the client has gone; the end of the input ends the session


class _Trainer:
    """The trainer's process, and the thread that listens to it."""

    def __init__(self, arguments: list[str], surface: np.ndarray, wishes: _Wishes,
                 events: _Events):
        self._surface, self._wishes, self._events = surface, wishes, events
        self._last_check = 0.0
        self._checked: np.ndarray | None = None
        self.busy = True
        self._process = subprocess.Popen(
            [sys.executable, "-m", "limber.session.trainer", *arguments],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            # Windows has no `nice` that the trainer could call itself.
            creationflags=getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0))
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        for line in self._process.stdout or ():
            try:
                content = json.loads(line)
            except json.JSONDecodeError:
                continue  # a native library's own words
            if content.get("event") == "model":
                self._hand_over(ReducedModel.read(Path(content.pop("path"))), content)
                self.busy = False
            elif content.get("event") == "check":
                self._events.say(**content)
                self.busy = False
            elif "progress" in content:
                self._events.say(event="progress", **content)
            else:
                self._events.say(**content)
        if not self._wishes.closed:
            self._events.say(event="warning", message="the trainer has ended; the reduced model"
                             " is no longer checked, or there is none")

    def _hand_over(self, model: ReducedModel, event: dict[str, Any]) -> None:
        # All that can be made ready is, so that no frame waits for it.
        columns = np.ascontiguousarray(
            model.basis.columns[:, self._surface].reshape(model.size, -1))
        self._wishes(model=model, surface_columns=columns, model_event=event)

    def check(self, state: ReducedState, move_id: int) -> None:
        """Ask for a comparison with the full model, if the trainer has time and news."""
        now = time.monotonic()
        if self.busy or now - self._last_check < _CHECK_INTERVAL or (
                self._checked is not None and np.allclose(self._checked, state.pose)):
            return
        self._last_check, self._checked, self.busy = now, state.pose, True
        request = {"command": "check", "id": move_id, "pose": state.pose.tolist(),
                   "young_pa": state.young.tolist()}
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
        except (BrokenPipeError, OSError):
            self._checked = None

    def close(self) -> None:
        self._process.kill()
        self._process.wait()


class Session:
    """The worker: solves for the newest pose and publishes frames."""

    def __init__(self, options: argparse.Namespace):
        self.model, self.grasp = load_branch(options)
        self.weights, self.young = as_control_points(self.model)
        faces = self.model.mesh.surface_faces()
        self.surface, compact = np.unique(faces, return_inverse=True)
        self.wishes, self.events = _Wishes(), _Events()
        path = options.positions
        if path is None:
            handle, name = tempfile.mkstemp(prefix="limber-session-", suffix=".pos")
            os.close(handle)
            path = Path(name)
        self.frames = FrameWriter(path, compact.reshape(-1, 3), len(self.surface))
        self.trainer: _Trainer | None = None
        self.state: ReducedState | None = None
        self.stepper: ReducedStepper | None = None
        self.displacement = np.zeros_like(self.model.mesh.nodes)
        self.full_pose = self.grasp.rest_pose
        self.reduced: ReducedModel | None = None
        self._base: ReducedModel | None = None
        self._young: np.ndarray = self.young
        self._surface_rest = self.model.mesh.nodes[self.surface]
        self._surface_columns = np.empty((0, 0))
        self._last_step = 0.0

    def run(self, trainer_arguments: list[str] | None) -> None:
        """Answer until the client closes or goes."""
        self.model.equations([self.grasp])
        _steady()
        self.events.say(event="hello", protocol=PROTOCOL, positions=str(self.frames.path),
                        vertex_count=len(self.surface), control_count=len(self.young),
                        rest_pose=self.grasp.rest_pose.tolist(), young_pa=self.young.tolist())
        threading.Thread(target=self._read_commands, daemon=True).start()
        if trainer_arguments is not None:
            self.trainer = _Trainer(trainer_arguments, self.surface, self.wishes,
                                    self.events)
        answered = -1
        try:
            while (wish := self._wait(answered)) is not None:
                answered = self._answer(*wish)
        finally:
            if self.trainer is not None:
                self.trainer.close()
            self.frames.close()
            self.events.close()

    def _wait(self, answered: int) -> tuple[np.ndarray, int, float] | None:
        """Return the newest pose with its number and time of receipt; None at the end."""
        wishes = self.wishes
        with wishes.changed:
            while not wishes.closed:
                new = wishes.pose is not None and wishes.move_id != answered
                if self._take_over() and wishes.pose is not None:
                    new = True
                if self.stepper is not None and wishes.pose is not None:
                    left = self._step_due(new) - time.monotonic()
                    if left <= 0:
                        return wishes.pose, wishes.move_id, wishes.received
                    wishes.changed.wait(left)
                    continue
                if new:
                    return wishes.pose, wishes.move_id, wishes.received
                wishes.changed.wait(0.1)
                if self.state is not None and self.trainer is not None:
                    self.trainer.check(self.state, answered)
        return None

    def _step_due(self, new: bool) -> float:
        """Return when the next step in time is due: soon after a new pose, else at the rate.

        While poses stream in a step waits a little for the next one: it would just miss it.
        """
        streams = time.monotonic() - self.wishes.received < _STREAM_SECONDS
        return self._last_step + (_SOONEST if new else _LATEST if streams else 1.0) / RATE

    def _take_over(self) -> bool:
        """Adopt a new reduced model, Young's modulus or way of answering; True if so."""
        wishes, changed = self.wishes, False
        if wishes.young is not None:
            self._young, wishes.young, changed = wishes.young, None, True
            self.model = self.model.with_young(self.weights @ self._young)
        if wishes.model is not None:
            self._base, wishes.model, changed = wishes.model, None, True
            self._surface_columns = wishes.surface_columns
            self.events.say(**wishes.model_event)
        if changed and self._base is not None:
            self.reduced = self._base.with_young(self._young)
            self.state, self.stepper = None, None
        if (self.stepper is not None) != (wishes.dynamics and self.reduced is not None):
            self.stepper = None
            if wishes.dynamics and self.reduced is not None:
                start = self.state or self.reduced.solve_static(self.full_pose)
                self.stepper = ReducedStepper(self.reduced, start, settings=_LIVE)
                self._last_step = time.monotonic() - 1 / RATE
            changed = True
        return changed

    def _answer(self, pose: np.ndarray, move_id: int, received: float) -> int:
        if self.stepper is not None:
            self._step(pose, move_id, received)
        elif self.reduced is not None:
            self._reduced(pose, move_id, received)
        else:
            return move_id if self._full(pose, move_id, received) else -1
        return move_id

    def _reduced(self, pose: np.ndarray, move_id: int, received: float) -> None:
        state = self.reduced.solve_static(pose, start=self.state, settings=_QUICK)
        if state.converged:
            self.state, self.full_pose = state, pose
        # Out of reach the branch stays where it was last: a false state would flicker.
        shown = self.state or state
        self._publish(shown.coordinates, received, id=move_id, is_trusted=state.trusted,
                      is_converged=state.converged, energy_j=shown.strain_energy,
                      wrench=(shown.reaction_force, shown.reaction_torque))
        if self.trainer is not None and state.converged:
            self.trainer.check(state, move_id)

    def _step(self, pose: np.ndarray, move_id: int, received: float) -> None:
        now = time.monotonic()
        # A step that came late is not made up for: the motion slows down, it does not burst.
        length = min(max(now - self._last_step, _SOONEST / RATE), _LATEST / RATE)
        self._last_step = now
        stepper = self.stepper
        self.full_pose = pose = self._within_reach(pose, length)
        good = stepper.move(pose, length)
        if not good:
            self.stepper = ReducedStepper(self.reduced, self.reduced.solve_static(pose),
                                          settings=_LIVE)
        self._publish(self.stepper.state.coordinates, received, id=move_id, is_trusted=good,
                      is_converged=good, energy_j=stepper.strain_energy,
                      kinetic_energy_j=stepper.kinetic_energy, time_s=stepper.state.time,
                      wrench=stepper.reaction(pose))

    def _within_reach(self, pose: np.ndarray, seconds: float) -> np.ndarray:
        """Return how far the gripper gets towards a pose: a jump would whip the branch."""
        way = _way(self.full_pose, pose, self.model.extent)
        part = _FASTEST * self.model.extent * seconds / max(way, 1e-12)
        return pose if part >= 1.0 else pose_between(self.full_pose, pose, part)

    def _publish(self, q: np.ndarray, received: float, *, wrench: tuple[np.ndarray, np.ndarray],
                 **numbers: float) -> None:
        moved = (q @ self._surface_columns).reshape(-1, 3)
        self._send(self._surface_rest + moved, received, wrench, is_reduced=1, **numbers)

    def _full(self, pose: np.ndarray, move_id: int, received: float) -> bool:
        """Go towards the pose with the full model; return whether it was reached."""
        way = _way(self.full_pose, pose, self.model.extent)
        part = min(1.0, _FULL_STEP * self.model.extent / max(way, 1e-12))
        goal = pose if part == 1.0 else pose_between(self.full_pose, pose, part)
        result = solve_static(self.model, grasp=self.grasp, pose=goal, start=self.displacement)
        if result.converged:
            self.displacement, self.full_pose = result.displacement, goal
        else:
            self.events.say(event="warning", message=result.message)
        self._send(self._surface_rest + self.displacement[self.surface], received,
                   (result.reaction_force, result.reaction_torque), id=move_id,
                   is_trusted=part == 1.0 and result.converged, is_converged=result.converged,
                   energy_j=result.strain_energy)
        return part == 1.0 or not result.converged

    def _send(self, positions: np.ndarray, received: float,
              wrench: tuple[np.ndarray, np.ndarray], **numbers: float) -> None:
        force, torque = wrench
        named = dict(zip(("force_x_n", "force_y_n", "force_z_n"), force, strict=True))
        named |= dict(zip(("torque_x_nm", "torque_y_nm", "torque_z_nm"), torque, strict=True))
        self.frames.publish(positions, delay_s=time.monotonic() - received, **named, **numbers)

    def _read_commands(self) -> None:
        for line in sys.stdin:
            try:
                self._obey(json.loads(line))
            except (InputError, ValueError, KeyError, TypeError) as error:
                self.events.say(event="warning", message=f"not understood: {line.strip()[:200]}"
                                f" ({error})")
            if self.wishes.closed:
                return
        self.wishes(closed=True)

    def _obey(self, request: dict[str, Any]) -> None:
        command = request["command"]
        if command == "move":
            self.wishes(pose=check_pose(request["pose"]), move_id=int(request.get("id", 0)),
                        received=time.monotonic())
        elif command == "young":
            young = np.array(request["young_pa"], float)
            if young.shape != self.young.shape or not (np.isfinite(young) & (young > 0)).all():
                raise InputError(f"{young.size} moduli.", f"{len(self.young)} positive values are"
                                 " needed.", "")
            self.wishes(young=young)
        elif command == "dynamics":
            self.wishes(dynamics=bool(request["on"]))
        elif command == "close":
            self.wishes(closed=True)
        else:
            raise InputError(f"Command {command!r}.", "It is not known.", "")


def _way(first: np.ndarray, second: np.ndarray, extent: float) -> float:
    """Return how far two poses are apart [m]; a radian counts as 0.3 of the extent."""
    return float(np.linalg.norm(second[:3] - first[:3])
                 + 0.3 * extent * np.linalg.norm(second[3:] - first[3:]))


def _steady() -> None:
    """Take away what would hold up a frame now and then.

    Kernels are loaded before the first frame needs them; BLAS keeps to one thread, for a second
    one waits for the trainer to leave its core; a waiting thread gets the interpreter within a
    millisecond; garbage collection looks at what is new only.
    """
    import scipy.linalg  # noqa: F401 (its BLAS must be there to be limited)

    compile_kernels()
    one_thread()
    sys.setswitchinterval(_SWITCH_SECONDS)
    gc.collect()
    gc.freeze()


def main(arguments: list[str] | None = None) -> int:
    """Run a session until its client closes it or goes."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = session_arguments(argparse.ArgumentParser(
        prog="python -m limber.session.worker", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter))
    parser.add_argument("--positions", type=Path, help="file for the frames; default temporary")
    parser.add_argument("--full-only", action="store_true", help="make no reduced model")
    options = parser.parse_args(arguments)
    try:
        session = Session(options)
    except LimberError as error:
        print(json.dumps({"event": "error", "message": str(error)}), flush=True)
        return error.exit_code
    session.run(None if options.full_only else _trainer_arguments(options))
    return 0


def _trainer_arguments(options: argparse.Namespace) -> list[str]:
    told = [str(options.folder), "--mode", options.mode, "--grasps", str(options.grasps),
            "--size", str(options.size), "--fields", str(options.fields),
            "--young-spread", str(options.young_spread)]
    if options.cache is not None:
        told += ["--cache", str(options.cache)]
    return [*told, "--no-cache"] if options.no_cache else told


if __name__ == "__main__":
    sys.exit(main())
