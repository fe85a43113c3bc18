"""Progress: spans of sub-tasks, cancelling from another thread, JSON lines."""

import io
import json
import subprocess
import sys
import threading
import time

import pytest

from limber.core.errors import Cancelled
from limber.core.progress import JsonSink, LogSink, Progress


def test_parts_map_onto_their_span():
    """A sub-task's 0..1 is its span of the whole, also two levels deep, and is clipped."""
    seen = []
    progress = Progress(lambda fraction, message, numbers: seen.append(fraction))
    part = progress.part(0.5, 1.0).part(0.0, 0.5)
    part(0.0)
    part(1.0)
    part(7.0)
    assert seen == [0.5, 0.75, 0.75]


def test_cancel_stops_the_work_at_its_next_report():
    """cancel() in one thread makes the next report in another raise, in sub-tasks too."""
    progress = Progress()
    part = progress.part(0.2, 0.4)
    thread = threading.Thread(target=progress.cancel)
    thread.start()
    thread.join()
    with pytest.raises(Cancelled):
        part(0.1, "on")


def test_json_lines_are_whole_and_throttled():
    """Many reports of one message give few lines; a new message always gives one."""
    stream = io.StringIO()
    progress = Progress(JsonSink(stream, interval_seconds=10))
    for step in range(100):
        progress(step / 200, "a", loss=0.5, not_known_yet=float("inf"))
    progress(0.9, "b")
    progress(1.0, "b")
    lines = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [line["message"] for line in lines] == ["a", "b", "b"]
    assert lines[0]["loss"] == 0.5 and "not_known_yet" not in lines[0]


@pytest.mark.slow
def test_a_sign_of_life_says_what_was_computed():
    """Beats come while nothing is reported; what this process and its children compute is in them.
    """
    from limber.core.processes.heartbeat import Heartbeat

    stream = io.StringIO()
    sink = JsonSink(stream)
    computing = "import time\nwhile time.process_time() < 0.4: pass"
    with Heartbeat(sink.say, 0.05):
        subprocess.run([sys.executable, "-c", computing], check=True)
        _wait_until(lambda: _computed(stream) > 0.01)
    count = len(stream.getvalue().splitlines())
    time.sleep(0.12)
    assert len(stream.getvalue().splitlines()) == count, "it ends with the work"


def _computed(stream):
    """Processor time between the first and the last beat [s]."""
    beats = [json.loads(line)["cpu_s"] for line in stream.getvalue().splitlines()]
    return max(beats, default=0) - min(beats, default=0)


def _wait_until(true):
    end = time.monotonic() + 60
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_without_a_terminal_a_line_says_what_goes_on():
    """It comes during a long step too, in which nothing is reported."""
    stream = io.StringIO()
    with LogSink("estimate", stream, interval_seconds=0.02) as sink:
        sink(0.25, "fitting", {"simulations": 4, "loss_m2": 0.5})
        _wait_until(lambda: stream.getvalue().count("\n") > 1)
    lines = stream.getvalue().splitlines()
    assert lines[-1] == "estimate: 0 s, 25 % fitting simulations 4, loss_m2 0.5"
