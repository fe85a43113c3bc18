"""The viewport's table: cost of the add-on inside Blender.

In the Blender of LIMBER_BLENDER, else in the bpy package; without a window, so nothing is drawn.
Only the part "window" has one, on the screen of DISPLAY or a virtual one.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.table import Asked, Part, Row, Setting
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.generated import generate_branch
from limber.results.scene.animation import scene_data
from limber.store import Branch

_SCREEN = (1280, 800)
_ROOT = Path(__file__).parents[2]
def _probed(setting: Setting, part: str) -> dict[str, Any]:
    """Results of one part of the probe, by measure; empty if Blender did not start."""
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        return _measured(Path(place), setting, part)


def _measured(place: Path, setting: Setting, part: str) -> dict[str, Any]:
    branch = place / "twig.branch"
    shutil.copytree(_ROOT / "blend_files" / "bending_branch", branch)
    scene_data(Branch.open(branch)).write(branch.with_suffix(".npz"))
    generate_branch(setting.seed % 1000, length=0.4, fork_count=0,
                    point_spacing=0.004).cloud.write_ply(place / "scan.ply")
    if part == "import":
        Cloud(np.random.default_rng(setting.seed).random((1_000_000, 3))).write_ply(
            place / "million.ply")
    settings = place / "settings.json"
    settings.write_text(json.dumps({
        "addon": str(_ROOT / "addon"), "branch": str(branch), "cloud": str(place / "scan.ply"),
        "large_cloud": str(place / "million.ply"), "quick": setting.quick, "seed": setting.seed,
        "part": part, "seconds": setting.budget.remaining,
        "learn_seconds": 20.0 if setting.quick else 200.0,
        "grab_seconds": 5.0 if setting.quick else 20.0}))
    environment = {"LIMBER_PYTHON": sys.executable} | os.environ
    with _screen(part) as display:
        if part == "window" and not display:
            return {}
        return _said([*_command(part), "--", str(settings)], environment | display)


def _command(part: str) -> list[str]:
    """The program that measures a part: Blender with a window or without, or this Python."""
    blender = os.environ.get("LIMBER_BLENDER")
    here = Path(__file__)
    if part == "window":
        return [str(blender), "--factory-startup", "--enable-event-simulate", "--window-geometry",
                "0", "0", *map(str, _SCREEN), "--python",
                str(here.with_name("viewport_window.py"))]
    probe = str(here.with_name("viewport_probe.py"))
    return [blender, "-b", "--factory-startup", "--python", probe] if blender else (
        [sys.executable, probe])


@contextmanager
def _screen(part: str) -> Iterator[dict[str, str]]:
    """The screen for a window: the user's, else a virtual one; nothing if there is neither."""
    if part != "window" or not os.environ.get("LIMBER_BLENDER") or (
            "DISPLAY" not in os.environ and shutil.which("Xvfb") is None):
        yield {}
        return
    if display := os.environ.get("DISPLAY"):
        yield {"DISPLAY": display}
        return
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "{}x{}x24".format(*_SCREEN),
         "-nolisten", "tcp"], pass_fds=[write], stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL)
    os.close(write)
    try:
        with os.fdopen(read) as stream:
            yield {"DISPLAY": f":{stream.readline().strip()}"}
    finally:
        server.terminate()
        server.wait(10)


def _said(command: list[str], environment: dict[str, str]) -> dict[str, Any]:
    """Run a program; return what it printed, by measure."""
    process = subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE,
                               stderr=subprocess.STDOUT)
    found: dict[str, Any] = {}
    said: list[str] = []
    for line in process.stdout:
        if line.startswith('{"measure"'):
            told = json.loads(line)
            found[told.pop("measure")] = told
        else:
            said.append(line)
    if process.wait():
        print(f"Blender ended with exit code {process.returncode}:\n{''.join(said[-20:])}")
    for name, numbers in found.items():
        if "error" in numbers:
            print(f"{name}: {numbers['error']}")
    print(f"Blender {found.get('blender', {}).get('version', 'did not start')}", flush=True)
    return found


Judged = Callable[[dict[str, Any]], tuple[str, bool]]


def _part(part: str, seconds: float, *rows: tuple[Asked, str, str, Judged], grows: bool = False,
          ) -> Part:
    """A part of the probe: of each row the requirement, the measure that it is read from, the
    number that gives its trials, if any, and what its numbers say.
    """
    def measured(setting: Setting) -> list[Row]:
        found = _probed(setting, part)
        return [_row(found.get(name), asked, *more) for asked, name, *more in rows]
    return Part(measured, seconds, tuple(row[0] for row in rows), grows=grows)


def _row(numbers: dict[str, Any] | None, asked: Asked, count: str, judged: Judged) -> Row:
    if numbers is None or "error" in numbers:
        return Row(*asked, "could not be measured", None, 0)
    return Row(*asked, *judged(numbers), numbers[count] if count else 1)


PARTS = {
    "frame-write": _part("frame write", 15, (
        Asked("frame write of 50,000 vertices", "0.5 ms"), "frame write", "frames",
        lambda m: (f"{m['median_ms']:.2f} ms (95 %: {m['high_ms']:.2f})", m["median_ms"] <= 0.5))),
    "grab": _part(
        "grab", 240,
        (Asked("grab loop on Blender's side, median / 95 %", "1 / 2 ms"), "grab", "poses",
         # Other programs had the processor for the rest of the time.
         lambda m: (f"{m['median_ms']:.2f} / {m['high_ms']:.2f} ms (of the processor "
                    f"{m['own_median_ms']:.2f} / {m['own_high_ms']:.2f})",
                    m["median_ms"] <= 1 and m["high_ms"] <= 2)),
        (Asked("pose to drawn mesh (without drawing), median / 95 %", "under 33 ms"), "grab",
         "poses", lambda m: (f"{m['drawn_median_ms']:.1f} / {m['drawn_high_ms']:.1f} ms "
                             f"({m['who']})", m["drawn_high_ms"] < 33)),
        (Asked("memory over grabs", "flat"), "grab memory", "grabs",
         lambda m: (f"{m['grown_mb']:+.1f} MB over the last 4/5", m["grown_mb"] < 5))),
    "window": _part(
        "window", 120,
        (Asked("grab in a window, frames per second", "30"), "window", "frames",
         lambda m: (f"{m['per_second']:.0f} ({m['who']})", m["per_second"] >= 30)),
        (Asked("grab in a window, mouse to drawn frame, median / 95 %", "95 %: 60 ms"), "window",
         "frames", lambda m: (f"{m['median_ms']:.0f} / {m['high_ms']:.0f} ms",
                              m["high_ms"] <= 60))),
    "import": _part(
        "import", 20,
        (Asked("import of 1,000,000 points", "3 s"), "import", "",
         lambda m: (f"{m['seconds']:.2f} s", m["seconds"] <= 3 and m["points"] == 1_000_000)),
        (Asked("the interface stands while it is read / shown", "50 / 250 ms"), "import", "",
         lambda m: (f"{m['reading_ms']:.0f} / {m['shown_ms']:.0f} ms",
                    m["reading_ms"] <= 50 and m["shown_ms"] <= 250))),
    "register": _part("register", 15, (
        Asked("registering", "100 ms"), "register", "",
        lambda m: (f"{m['again_ms']:.0f} ms ({m['first_ms']:.0f} with the first import)",
                   m["again_ms"] <= 100))),
    "undo": _part("undo", 40, (
        Asked("undo and redo, random sequences", "state consistent, no crash"), "undo",
        "sequences", lambda m: (f"{m['wrong_count']} of {m['sequences']} wrong ({m['steps']} "
                                "steps)", m["wrong_count"] == 0)), grows=True),
    "job-memory": _part("job memory", 30, (
        Asked("memory over job runs", "flat"), "job memory", "jobs",
        lambda m: (f"{m['grown_mb']:+.1f} MB over the last 4/5; {m['threads']} threads, "
                   f"{m['files']} files open", m["grown_mb"] < 5 and m["threads"] < 5)))}
"""The table, in order of importance; each part has a Blender of its own."""
