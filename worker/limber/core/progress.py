"""Reports of long work: progress and warnings, the same for a terminal and a test.

A long function takes ``progress: Progress = SILENT`` and calls it during the work::

    progress(0.4, "contracting", iteration=7)

A call raises :class:`limber.core.errors.Cancelled` once the work has been cancelled, so the work
can stop at every call. ``progress.part(0.2, 0.6)`` is a view for a sub-task.
``progress.warn(message)`` reports a warning that does not stop the work, ``progress.say(line)``
what has been done so far.
"""

import contextlib
import json
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, TextIO

from limber.core.errors import Cancelled, Part, Text

Sink = Callable[[float, str, dict[str, Any]], None]


class Progress:
    """Passes progress and warnings to their receivers; raises ``Cancelled`` after :meth:`cancel`.

    Args:
        sink: Gets fraction, message and numbers.
        on_warning: Gets each warning.
        on_line: Gets each line of what has been done.
    """

    def __init__(self, sink: Sink | None = None,
                 on_warning: Callable[[Text], object] = lambda _message: None,
                 on_line: Callable[[str], object] = lambda _line: None, *,
                 _span: tuple[float, float] = (0.0, 1.0), _stop: threading.Event | None = None):
        self._sink = sink
        self._on_warning = on_warning
        self._on_line = on_line
        self._span = _span
        self._stop = _stop or threading.Event()

    def __call__(self, fraction: float, message: str = "", **numbers: Any) -> None:
        """Report ``fraction`` in [0, 1] with a short message and named numbers."""
        if self._stop.is_set():
            raise Cancelled
        if self._sink is not None:
            start, stop = self._span
            clipped = min(max(float(fraction), 0.0), 1.0)
            # A bound that is not known yet is infinite; JSON has no word for it.
            known = {name: value for name, value in numbers.items() if value != float("inf")}
            self._sink(start + (stop - start) * clipped, message, known)

    def warn(self, *message: Part) -> None:
        """Warn the user of something that does not stop the work, in the parts of a ``Text``."""
        self._on_warning(Text(*message))

    def say(self, line: str) -> None:
        """Print what has been done, or a table, for people."""
        self._on_line(line)

    def part(self, start: float, stop: float) -> "Progress":
        """Return a progress whose 0..1 is ``start..stop`` of this one."""
        low, high = self._span
        span = (low + (high - low) * start, low + (high - low) * stop)
        return Progress(self._sink, self._on_warning, self._on_line, _span=span, _stop=self._stop)

    def named(self, name: str) -> "Progress":
        """Return the same progress, its warnings prefixed with ``name``."""
        return self._with_warnings(lambda message: self.warn(f"{name}: ", message))

    def keeping(self, warnings: list[str], *, silently: bool = False) -> "Progress":
        """Return the same progress, each of its warnings also appended to ``warnings``.

        ``silently``: the user does not hear them until they are passed on.
        """
        def keep(message: Text) -> None:
            warnings.append(message)
            if not silently:
                self.warn(message)
        return self._with_warnings(keep)

    def _with_warnings(self, on_warning: Callable[[Text], None]) -> "Progress":
        return Progress(self._sink, on_warning, self._on_line, _span=self._span, _stop=self._stop)

    def to_the_end(self) -> "Progress":
        """Return the same progress for work that is finished even though it was cancelled."""
        return Progress(self._sink, self._on_warning, self._on_line, _span=self._span)

    def cancel(self) -> None:
        """Make the next report, from any thread, raise ``Cancelled``."""
        self._stop.set()

    @property
    def cancelled(self) -> bool:
        return self._stop.is_set()


SILENT = Progress()


class JsonSink:
    """Writes one JSON object per line: ``{"progress", "message", "seconds", ...numbers}``."""

    def __init__(self, stream: TextIO | None = None, *, interval_seconds: float = 0.05):
        self._stream = stream or sys.stdout
        self._interval = interval_seconds
        self._lock = threading.Lock()
        self._start = time.perf_counter()
        self._last = -1.0
        self._last_message = ""

    def __call__(self, fraction: float, message: str, numbers: dict[str, Any]) -> None:
        now = time.perf_counter() - self._start
        due = now - self._last >= self._interval or message != self._last_message
        if not (due or fraction >= 1.0):
            return
        self._last, self._last_message = now, message
        self.say({"progress": round(fraction, 4), "message": message, "seconds": round(now, 3)}
                 | numbers)

    def say(self, content: dict[str, Any]) -> None:
        """Write one line, from any thread."""
        text = json.dumps(content, default=float) + "\n"
        with self._lock:
            self._stream.write(text)
            self._stream.flush()


class BarSink:
    """Draws a bar on standard error, with the last message and the numbers beside it."""

    def __init__(self, title: str):
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as RichProgress
        from rich.table import Column

        # In a narrow window the message is shortened, never the bar and its percentage.
        self._bar = RichProgress(
            TextColumn("{task.fields[title]}",
                       table_column=Column(no_wrap=True, min_width=len(title))),
            BarColumn(bar_width=20, table_column=Column(no_wrap=True, min_width=20)),
            TextColumn("{task.percentage:3.0f} %", table_column=Column(no_wrap=True, min_width=5)),
            TimeElapsedColumn(table_column=Column(no_wrap=True, min_width=7)),
            TextColumn("{task.description}", table_column=Column(no_wrap=True, ratio=1)),
            console=Console(stderr=True), expand=True,
        )
        self._task = self._bar.add_task("", total=1.0, title=title)

    def __enter__(self) -> "BarSink":
        self._bar.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._bar.stop()

    def __call__(self, fraction: float, message: str, numbers: dict[str, Any]) -> None:
        self._bar.update(self._task, completed=fraction,
                         description=f"{message} {_figures(numbers)}".strip())

    def say(self, line: str) -> None:
        """Print a line above the bar."""
        self._bar.console.print(line, markup=False, highlight=False)


class LogSink:
    """Writes a line to standard error every ten seconds, during a long step too as a thread does
    it: for a log, where no bar can be drawn."""

    def __init__(self, title: str, stream: TextIO | None = None, *, interval_seconds: float = 10.0):
        self._title, self._interval = title, interval_seconds
        self._stream = stream or sys.stderr
        self._last = (0.0, "", "")
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._write, name="progress log", daemon=True)

    def __enter__(self) -> "LogSink":
        self._thread.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._ended.set()
        self._thread.join()

    def __call__(self, fraction: float, message: str, numbers: dict[str, Any]) -> None:
        self._last = fraction, message, _figures(numbers)

    def _write(self) -> None:
        start = time.perf_counter()
        while not self._ended.wait(self._interval):
            fraction, message, figures = self._last
            seconds = time.perf_counter() - start
            text = f"{self._title}: {seconds:.0f} s, {100 * fraction:.0f} % {message} {figures}"
            print(text.strip(), file=self._stream, flush=True)


class LineSink(contextlib.AbstractContextManager):
    """Rewrites one line of text: for a notebook, whose output does not support a bar."""

    def __init__(self, title: str, stream: TextIO | None = None, *, interval_seconds: float = 0.1):
        self._title = title
        self._stream = stream or sys.stderr
        self._interval = interval_seconds
        self._last = -interval_seconds
        self._shown = ""

    def __exit__(self, *_exception: object) -> None:
        self._write("")
        self._stream.write("\r")

    def __call__(self, fraction: float, message: str, numbers: dict[str, Any]) -> None:
        now, text = time.perf_counter(), f"{self._title} {100 * fraction:3.0f} % {message}"
        if text != self._shown and now - self._last >= self._interval:
            self._last = now
            self._write(text)

    def _write(self, text: str) -> None:
        """Overwrite the previous line."""
        print("\r" + text.ljust(len(self._shown)), end="", file=self._stream, flush=True)
        self._shown = text


def _figures(numbers: dict[str, Any]) -> str:
    """Return the numbers as text: ``remaining_s=12`` is *remaining 12 s*."""
    return ", ".join(f"{name.removesuffix('_s')} {_short(value)}{' s' * name.endswith('_s')}"
                     for name, value in numbers.items())


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
