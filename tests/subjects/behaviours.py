"""Jobs that behave well and badly: as functions for a pool, as a program for who starts programs.

    python behaviours.py NAME

The program reports as a stage does, and ends with its parent as a stage does.
"""

import json
import os
import signal
import sys
import time

from limber.core.errors import LimberError, WorkError
from limber.core.progress import SILENT, JsonSink, Progress

RUBBISH = (b"fTetWild says hello\n" b"[1, 2]\n" b"{broken\n" b"\xff\xfe\x00\xf0\n"
           + b"[" * 100_000 + b"\n" + b"9" * 10_000 + b"\n"
           b'{"progress": "much"}\n' b'{"progress": 1e400}\n' b'{"progress": NaN}\n'
           b'{"progress": [0.5]}\n' b'{"progress": 0.5, "fraction": 1, "self": 2}\n'
           + b"x" * 1_000_000 + b"\n" b'{"stat')


def steps(progress: Progress = SILENT) -> dict:
    """Reports as it goes and returns a result."""
    for step in range(5):
        progress(step / 4, "going", step=step)
        time.sleep(0.06)
    return {"n": 3}


def rubbish(progress: Progress = SILENT) -> dict:
    """Native libraries write what they like on standard output."""
    os.write(1, RUBBISH + b"\n")
    progress(0.5, "half")
    return {"n": 3}


def fails(progress: Progress = SILENT) -> dict:
    """Ends with an error of its own."""
    progress(0.5, "half")
    raise WorkError("The wood is too wet.")


def crash(progress: Progress = SILENT) -> dict:
    """Dies in native code."""
    progress(0.5, "half")
    os.kill(os.getpid(), signal.SIGSEGV) if os.name == "posix" else os._exit(139)
    return {}


def patient(progress: Progress = SILENT) -> dict:
    """Works for a minute and reports all the time."""
    for step in range(1200):
        progress(step / 1200, "on")
        time.sleep(0.05)
    return {}


def hang(progress: Progress = SILENT) -> dict:
    """Says nothing, and does not end when asked to."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    progress(0.1, "about to hang")
    time.sleep(60)
    return {}


def greedy(progress: Progress = SILENT) -> dict:
    """Takes ever more memory."""
    held = []
    while True:
        held.append(b"x" * (1 << 26))
        progress(0.1, "taking")
        time.sleep(0.05)


def _interrupted(_signal: int, _frame: object) -> None:
    raise KeyboardInterrupt


def main(name: str) -> int:
    """Run one as a program; returns the exit code."""
    from limber.core.processes.end_with_parent import end_with_parent_pipe

    signal.signal(signal.SIGTERM, _interrupted)
    end_with_parent_pipe(grace_seconds=0.3)
    # A library that asks for input must not wait for ever.
    assert sys.stdin.read() == ""
    code, outcome = 0, {"command": name, "status": "done", "error": None}
    try:
        outcome |= globals()[name](Progress(JsonSink(interval_seconds=0.0)))
    except LimberError as error:
        code, outcome = error.exit_code, outcome | {"status": error.status, "error": str(error)}
    except KeyboardInterrupt:
        code, outcome = 130, outcome | {"status": "cancelled", "error": "Cancelled."}
    print(json.dumps(outcome), flush=True)
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
