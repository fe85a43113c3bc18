"""The effects of outdoor loads on the held branch, computed in a separate process.

It takes seconds; the branch can be moved meanwhile. The answer is for the branch as stored in its
folder, with the moduli and loads of the session at the time of the request.
"""

import json
import os
import queue
import sys
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import Cancelled, InputError, LimberError
from limber.core.json_values import plain
from limber.core.processes import Pool
from limber.core.progress import Progress
from limber.mechanics.loads.load_effects import (
    Gusts,
    Turbulence,
    WindRecord,
    blown,
    load_effects,
    with_peak,
)
from limber.mechanics.loads.outdoor import Outdoors
from limber.session.protocol import Effects, SessionSettings
from limber.session.session_branch import HeldBranch, load_held
from limber.store import Branch
from limber.store.loading import known_damping

# Writes a session's events in a thread: a client that does not read does not stop the frames.

_WAITING_LIMIT = 1000


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
