"""The choice of the model that answers for the held branch, and the models being learnt."""

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from limber.core.errors import InputError, LimberError, Option
from limber.core.numerics.rigid import pose_between
from limber.core.processes.child import Child
from limber.mechanics.dynamics.integration import NewmarkSettings
from limber.mechanics.grasp import Grasp
from limber.mechanics.loads.outdoor import LoadedOutdoors, Outdoors
from limber.reduced.model_cache import read_model
from limber.reduced.reduced_model import (
    ReducedModel,
    ReducedState,
    ReducedStaticSettings,
    ReducedStepper,
)
from limber.session.frame_buffer import HeldAt, Status
from limber.session.protocol import Load, SessionSettings
from limber.session.session_branch import Answer, HeldBranch

# The trainer's process as a session sees it, and the thread that listens to it.

_CHECK_INTERVAL = 1.0


@dataclass(frozen=True)
class Learnt:
    """A reduced model that is ready, with the data that a frame needs; ``key`` states its grasp."""

    key: tuple[str, bytes]
    model: ReducedModel
    event: dict[str, Any]


@dataclass(frozen=True)
class Checked:
    """A comparison with the full model at a pose [m, rad]."""

    key: tuple[str, bytes]
    pose: np.ndarray
    good: bool
    event: dict[str, Any]


def key_of(grasp: Grasp) -> tuple[str, bytes]:
    """Return the key of a learnt model: the patch, and how it is held."""
    return grasp.mode, grasp.nodes.tobytes() + grasp.weights.tobytes()


class Learning:
    """A trainer at work on one grasp. ``tell`` receives :class:`Learnt` and :class:`Checked`, from
    another thread; ``say`` the trainer's other events."""

    def __init__(self, folder: Path, settings: SessionSettings, grasp: Grasp,
                 tell: Callable[[Learnt | Checked], object], say: Callable[..., None]):
        self.key = key_of(grasp)
        self.has_failed = False
        self._tell, self._say = tell, say
        self._last_check = 0.0
        self._checked: np.ndarray | None = None
        self._busy, self._closed = True, False
        self._child = Child(
            [sys.executable, "-m", "limber.session.trainer", str(folder),
             settings.model_dump_json()], self._hear, self._ended,
            # Windows has no `nice` for the trainer to call itself.
            creationflags=getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0))
        self._write({"nodes": grasp.nodes.tolist(), "weights": grasp.weights.tolist(),
                     "mode": grasp.mode})

    def check(self, state: ReducedState) -> None:
        """Request a comparison with the full model, if the trainer is free and the pose is new."""
        now = time.monotonic()
        if self._busy or now - self._last_check < _CHECK_INTERVAL or (
                self._checked is not None and np.allclose(self._checked, state.pose)):
            return
        self._last_check, self._checked, self._busy = now, state.pose, True
        self._write({"pose": state.pose.tolist(), "young_pa": state.young.tolist()})

    def close(self) -> None:
        """End the process."""
        self._closed = True
        self._child.kill()

    def _write(self, line: dict[str, Any]) -> None:
        try:
            self._child.send(line)
        except ConnectionError:
            self._checked = None  # it has ended, which `_ended` reports

    def _ended(self) -> None:
        if not self._closed:
            self.has_failed = True
            self._say(event="warning", message="the trainer has ended; the reduced model is no "
                      "longer checked, or does not exist")

    def _hear(self, content: dict[str, Any]) -> bool:
        if self._closed:
            return True
        kind = content.get("event")
        if kind == "model":
            self._adopt(content)
        elif kind == "check":
            if self._checked is not None:
                self._tell(Checked(self.key, self._checked, bool(content["good"]), content))
            self._busy = False
        elif "progress" in content:
            self._say(event="progress", **content)
        elif kind == "failed":
            self._say(event="warning", message=f"there is no reduced model: {content['message']}")
        else:
            self._say(**content)
        return True

    def _adopt(self, content: dict[str, Any]) -> None:
        try:
            model = read_model(Path(content.pop("path")))
        except LimberError as error:
            self._say(event="warning", message=f"the reduced model was lost: {error}")
            return
        self._busy = False
        self._tell(Learnt(self.key, model, content))


RATE = 60.0
"""Steps per second in dynamics."""
_FASTEST = 2.0
"""Largest speed of the gripper in dynamics, in extents of the branch per second."""
_SOONEST, _LATEST = 0.6, 1.4
"""Bounds of a step's length in dynamics, as fractions of 1 / RATE."""
_STREAM_SECONDS = 0.1
_IDLE_SECONDS = 0.1
_DOUBTED = 0.02
"""Distance, as a fraction of the extent, within which a pose shares the doubt of one whose check
failed.
"""
_KNOWN_LIMIT = 3
"""Number of reduced models kept in memory, for the most recent grasps."""
_LIVE = NewmarkSettings(beta=0.3025, gamma=0.6, max_iterations=10)
"""Damps motion that is too fast for the step: poses of a mouse are jerky."""
_QUICK = ReducedStaticSettings(max_iterations=12, max_halvings=2, start_count=2)


class Answering:
    """Answers for a branch with the reduced model of its one grasp, else with the full one: also
    under loads or without weight, which it has not learnt; motion is then not reliable. ``tell``
    passes the trainer's results to :meth:`hear`, from its thread; ``say`` writes an event."""

    def __init__(self, folder: Path, settings: SessionSettings, held: HeldBranch,
                 tell: Callable[[Learnt | Checked], object], say: Callable[..., None]):
        self.held = held
        self._folder, self._settings, self._tell, self._say = folder, settings, tell, say
        self._learning: Learning | None = None
        self._known: dict[tuple[str, bytes], ReducedModel] = {}
        self._reduced: ReducedModel | None = None
        self._state: ReducedState | None = None
        self._stepper: ReducedStepper | None = None
        self._wants_motion = False
        self._last_step = 0.0
        self._doubted: list[np.ndarray] = []
        self._is_due = self._is_new = False

    @property
    def is_moving(self) -> bool:
        """Whether motion over time was requested."""
        return self._wants_motion

    @property
    def is_learning(self) -> bool:
        """Whether a reduced model of the held branch is being learnt."""
        key, learning = self._key, self._learning
        return (key is not None and key not in self._known and learning is not None
                and learning.key == key and not learning.has_failed)

    def status(self, answer: Answer) -> Status:
        """Return the model that gave an answer, and whether it is reliable."""
        if not answer.is_converged:
            return Status.untrusted
        if answer.is_reduced:
            return Status.reduced if answer.is_trusted else Status.untrusted
        return Status.learning if self.is_learning else Status.full

    def rest(self) -> Answer:
        """Return the rest shape, solved for the held grasps."""
        return self.held.solve()

    def hold_marked(self, mode: Literal["rigid", "point"]) -> None:
        """Hold the patch that the mesh marks, if it marks one."""
        if np.any(self.held.model.mesh.point_data.get("grasp", 0)):
            self.held.hold(self.held.loaded.marked_grasp(mode))

    def aim(self, number: int | None, pose: np.ndarray) -> None:
        """Set the target pose of a grasp."""
        self.held.aim(number, pose)
        self._is_due = self._is_new = True

    def grab(self, vertex: int | None, point: tuple[float, float, float] | None, radius: float,
             mode: Literal["rigid", "point"]) -> int:
        """Hold a patch in its current position; return its number."""
        number = self.held.grab(vertex, point, radius, mode)
        self._changed()
        return number

    def release(self, number: int | None) -> None:
        """Release a grasp, or all."""
        self.held.release(number)
        self._changed()

    def set_gravity(self, on: bool) -> None:
        """Switch the branch's weight on or off."""
        self.held.set_gravity(on)
        self._choose()

    def set_young(self, young: np.ndarray) -> None:
        """Set Young's modulus at the control points [Pa]."""
        self.held.set_young(young)
        self._doubted.clear()
        self._choose()

    def set_loads(self, loads: list[Load]) -> None:
        """Hang other forces on the branch."""
        self.held.set_loads(loads)
        self._choose()

    def set_outdoors(self, loads: Outdoors) -> LoadedOutdoors:
        """Apply weather and cut twigs off; see :meth:`.HeldBranch.set_outdoors`."""
        made = self.held.set_outdoors(loads)
        self._choose()
        return made

    def set_dynamics(self, on: bool) -> None:
        """Switch between motion over time and equilibria."""
        if on and not self._settings.reduced:
            raise InputError("Motion needs a reduced model.", "This session was started without "
                             "one.", "Start it with ", Option("reduced", True), ".")
        self._wants_motion = on
        self._choose()

    def hear(self, word: Learnt | Checked) -> None:
        """Receive a model or a comparison from the trainer."""
        self._say(**word.event)
        if isinstance(word, Learnt):
            self._known.pop(word.key, None)
            self._known[word.key] = word.model
            while len(self._known) > _KNOWN_LIMIT:
                del self._known[next(iter(self._known))]
            self._doubted.clear()
            if word.key == self._key:
                self._choose()
        elif not word.good and word.key == self._key:
            self._doubted = [*self._doubted[-99:], word.pose]
            self._is_due = True

    def learn(self) -> None:
        """Make a trainer work on the held branch, if one model can answer for it."""
        key = self._key
        if key is None or not self._settings.reduced:
            return
        if self._learning is not None:
            if self._learning.key == key:
                return
            self._learning.close()
        (held,) = self.held.grasps.values()
        self._learning = Learning(self._folder, self._settings, held.grasp,
                                  self._tell, self._say)

    def seconds_left(self, last_received: float) -> float:
        """Return the waiting time for another command before :meth:`answer` is due."""
        if self._stepper is not None:
            return max(self._step_due(last_received) - time.monotonic(), 0.0)
        return 0.0 if self._is_due else _IDLE_SECONDS

    def answer(self, last_received: float) -> Answer | None:
        """Return the next state to show; None if there is nothing new or it is too early."""
        if self._stepper is not None:
            if self._step_due(last_received) > time.monotonic():
                return None
            self._is_due = self._is_new = False
            return self._step(self._stepper)
        if not self._is_due:
            if self._state is not None and self._learning is not None:
                self._learning.check(self._state)
            return None
        self._is_due = self._is_new = False
        if self._reduced is not None:
            return self._from_reduced(self._reduced)
        answer = self.held.solve()
        if answer.message:
            self._say(event="warning", message=answer.message)
        self._is_due = answer.is_converged and not answer.is_reached
        return answer

    def give_up(self) -> None:
        """Return to equilibria, and wait for the next command: this one has failed."""
        self._is_due = self._wants_motion = False
        self._stepper = self._state = None

    def close(self) -> None:
        """End the trainer."""
        if self._learning is not None:
            self._learning.close()

    @property
    def _key(self) -> tuple[str, bytes] | None:
        if len(self.held.grasps) != 1:
            return None
        (held,) = self.held.grasps.values()
        return key_of(held.grasp)

    def _changed(self) -> None:
        self._doubted.clear()
        self.learn()
        self._choose()

    def _choose(self) -> None:
        """Take the model for the current grasps, static or dynamic as requested."""
        key = self._key
        base = None if key is None else self._known.get(key)
        reduced = None if base is None else base.with_young(self.held.young)
        self._reduced = reduced if self.held.loads is None else None
        self._state, self._stepper = None, None
        self._is_due = True
        if self._wants_motion and reduced is not None:
            (held,) = self.held.grasps.values()
            start = reduced.solve_static(held.pose, nodal_forces=self.held.loads)
            self._stepper = ReducedStepper(reduced, start, nodal_forces=self.held.loads,
                                           settings=_LIVE)
            self._last_step = time.monotonic() - 1 / RATE

    def _step_due(self, last_received: float) -> float:
        """Return when the next step in time is due: soon after a new pose, else at the rate. While
        poses stream in, a step waits briefly for the next one: it would just miss it."""
        streams = time.monotonic() - last_received < _STREAM_SECONDS
        part = _SOONEST if self._is_new else _LATEST if streams else 1.0
        return self._last_step + part / RATE

    def _from_reduced(self, reduced: ReducedModel) -> Answer:
        ((number, held),) = self.held.grasps.items()
        state = reduced.solve_static(held.goal, start=self._state, settings=_QUICK)
        if state.converged:
            self._state = state
            self.held.put(number, held.goal, reduced.displacement(state))
        # Out of reach the branch stays in its last position: a false state would flicker.
        current = self._state or state
        displacement = self.held.displacement if self._state is not None else (
            reduced.displacement(current))
        if self._learning is not None and state.converged:
            self._learning.check(state)
        at = HeldAt(number, current.pose, current.reaction_force, current.reaction_torque)
        return Answer(displacement, (at,), current.energy, is_converged=state.converged,
                      is_reached=state.converged, is_reduced=True,
                      is_trusted=state.trusted and not self._is_doubted(state.pose))

    def _is_doubted(self, pose: np.ndarray) -> bool:
        """Whether the reduced model was found wrong near here, and has not learnt since."""
        near = _DOUBTED * self.held.model.extent
        return any(np.linalg.norm(pose[:3] - bad[:3]) < near for bad in self._doubted)

    def _step(self, stepper: ReducedStepper) -> Answer:
        now = time.monotonic()
        # A late step is not made up for: the motion slows down instead of catching up.
        length = min(max(now - self._last_step, _SOONEST / RATE), _LATEST / RATE)
        self._last_step = now
        ((number, held),) = self.held.grasps.items()
        pose = self._within_reach(held.pose, held.goal, self.held.goal_distance(number), length)
        good = stepper.move(pose, length)
        reduced = stepper.model
        if not good:
            start = reduced.solve_static(pose, nodal_forces=self.held.loads)
            self._stepper = ReducedStepper(reduced, start, nodal_forces=self.held.loads,
                                           settings=_LIVE)
            coordinates = self._stepper.state.coordinates
        else:
            coordinates = stepper.state.coordinates
        displacement = reduced.displacement_of(coordinates)
        self.held.put(number, pose, displacement)
        return Answer(displacement, (HeldAt(number, pose, *stepper.reaction(pose)),),
                      stepper.energy, stepper.kinetic_energy, stepper.state.time,
                      is_converged=good, is_reached=bool(np.array_equal(pose, held.goal)),
                      is_reduced=True, is_trusted=good and self.held.loads is None)

    def _within_reach(self, pose: np.ndarray, goal: np.ndarray, distance: float,
                      seconds: float) -> np.ndarray:
        """Return how far the gripper moves towards a pose: a jump would whip the branch."""
        part = _FASTEST * self.held.model.extent * seconds / max(distance, 1e-12)
        return goal if part >= 1.0 else pose_between(pose, goal, part)
