"""The viewport's table: what the add-on costs inside Blender.

In the Blender of LIMBER_BLENDER, else in the bpy package; without a window, so nothing is drawn.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.table import Row
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.generated import generate_branch
from limber.progress import Progress
from limber.scene.data import scene_data
from limber.store import Branch

_ROOT = Path(__file__).parents[2]
_LONGEST_SECONDS = 1400


def rows(quick: bool, progress: Progress, out: Path | None, seed: int) -> list[Row]:
    """Measure; ``quick`` takes a fifth of the repeats and a tenth of the sequences."""
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        found = _measured(Path(place), quick, seed, progress)
    for name, numbers in found.items():
        if "error" in numbers:
            print(f"{name}: {numbers['error']}")
    return _table(found)


def _measured(place: Path, quick: bool, seed: int, progress: Progress) -> dict[str, Any]:
    branch = place / "twig.branch"
    shutil.copytree(_ROOT / "blend_files" / "bending_branch", branch)
    scene_data(Branch.open(branch)).write(branch.with_suffix(".npz"))
    generate_branch(seed % 1000, length=0.4, fork_count=0, point_spacing=0.004).cloud.write_ply(
        place / "scan.ply")
    Cloud(np.random.default_rng(seed).random((1_000_000, 3))).write_ply(place / "million.ply")
    settings = place / "settings.json"
    settings.write_text(json.dumps({
        "addon": str(_ROOT / "addon"), "branch": str(branch), "cloud": str(place / "scan.ply"),
        "large_cloud": str(place / "million.ply"), "quick": quick, "seed": seed}))
    probe = str(Path(__file__).with_name("viewport_probe.py"))
    blender = os.environ.get("LIMBER_BLENDER")
    command = [blender, "-b", "--factory-startup", "--python", probe] if blender else (
        [sys.executable, probe])
    environment = {"LIMBER_PYTHON": sys.executable} | os.environ
    process = subprocess.Popen([*command, "--", str(settings)], env=environment, text=True,
                               stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    found: dict[str, Any] = {}
    said: list[str] = []
    for line in process.stdout:
        if line.startswith('{"measure"'):
            told = json.loads(line)
            found[told.pop("measure")] = told
            progress(len(found) / 8, "measuring")
        else:
            said.append(line)
    if process.wait(_LONGEST_SECONDS):
        print(f"Blender ended with exit code {process.returncode}:\n{''.join(said[-20:])}")
    return found


def _table(found: dict[str, Any]) -> list[Row]:
    print(f"Blender {found.get('blender', {}).get('version', 'did not start')}")
    return [
        _row(found, "frame write", "frame write of 50,000 vertices", "0.5 ms",
             lambda m: (f"{m['median_ms']:.2f} ms (95 %: {m['high_ms']:.2f})",
                        m["median_ms"] <= 0.5)),
        _row(found, "grab", "grab loop on Blender's side, median / 95 %", "1 / 2 ms",
             # The rest of the time other programs had the processor.
             lambda m: (f"{m['median_ms']:.2f} / {m['high_ms']:.2f} ms (of the processor "
                        f"{m['own_median_ms']:.2f} / {m['own_high_ms']:.2f})",
                        m["median_ms"] <= 1 and m["high_ms"] <= 2)),
        _row(found, "grab", "pose to drawn mesh (without drawing), median / 95 %", "under 33 ms",
             lambda m: (f"{m['drawn_median_ms']:.1f} / {m['drawn_high_ms']:.1f} ms ({m['who']})",
                        m["drawn_high_ms"] < 33)),
        _row(found, "import", "import of 1,000,000 points", "3 s",
             lambda m: (f"{m['seconds']:.2f} s", m["seconds"] <= 3 and m["points"] == 1_000_000)),
        _row(found, "import", "the interface stands while it is read / shown", "50 / 250 ms",
             lambda m: (f"{m['reading_ms']:.0f} / {m['shown_ms']:.0f} ms",
                        m["reading_ms"] <= 50 and m["shown_ms"] <= 250)),
        _row(found, "register", "registering", "100 ms",
             lambda m: (f"{m['again_ms']:.0f} ms ({m['first_ms']:.0f} with the first import)",
                        m["again_ms"] <= 100)),
        _row(found, "grab memory", "memory over grabs", "flat",
             lambda m: (f"{m['grown_mb']:+.1f} MB over the last 4/5 of {m['grabs']}",
                        m["grown_mb"] < 5)),
        _row(found, "job memory", "memory over job runs", "flat",
             lambda m: (f"{m['grown_mb']:+.1f} MB over the last 4/5 of {m['jobs']}; "
                        f"{m['threads']} threads, {m['files']} files open",
                        m["grown_mb"] < 5 and m["threads"] < 5)),
        _row(found, "undo", "undo and redo, random sequences", "state consistent, no crash",
             lambda m: (f"{m['wrong_count']} of {m['sequences']} wrong ({m['steps']} steps)",
                        m["wrong_count"] == 0))]


def _row(found: dict[str, Any], name: str, measure: str, asked: str, judged) -> Row:
    numbers = found.get(name)
    if numbers is None or "error" in numbers:
        return Row(measure, asked, "could not be measured", None)
    measured, met = judged(numbers)
    return Row(measure, asked, measured, met)
