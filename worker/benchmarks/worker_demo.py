"""A newcomer's first run: size of the installation, time of `limber demo`, its results."""

import importlib.metadata
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import limber
from benchmarks.table import Asked, Row, Setting

DEMO_ROWS = (
    Asked("all packages, installed", "report"),
    Asked("limber demo: by the clock; processor time", "report"),
    Asked("limber demo: largest memory of a process", "report"),
    Asked("limber demo: 95 % intervals that hold the true modulus", "3 of 4"),
    Asked("limber demo: energy along the gentle path, less than the shortest's by", "over 0 %"))


def run_demo(_setting: Setting) -> list[Row]:
    """Run it with its own seed, without a scene, in an empty folder."""
    with tempfile.TemporaryDirectory(prefix="limber-demo-") as place:
        began, used = time.perf_counter(), _processor_seconds()
        done = subprocess.run(
            [sys.executable, "-m", "limber", "demo", "-o", str(Path(place, "out")), "--json",
             "--progress", "none"], capture_output=True, text=True, check=True)
        seconds, spent = time.perf_counter() - began, _processor_seconds() - used
        found = json.loads(done.stdout.splitlines()[-1])
        results = limber.open(found["branch"]).results
        true = results["pull:pull-1"].values["young_true_pa"]
        held = sum(low <= value <= high for value, (low, high) in
                   zip(true, results["estimate"].interval, strict=True))
    saved = found["energy_saved_percent"]
    # Linux states kibibytes.
    memory = 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    measured = (f"{_installed_bytes() / 1e9:.1f} GB", f"{seconds:.0f} s; {spent:.0f} s",
                f"{memory / 1e6:.0f} MB", f"{held} of {len(true)}", f"{saved:.0f} %")
    met = (None, None, None, held >= 3, saved > 0)
    return [Row(*asked, told, is_met) for asked, told, is_met in
            zip(DEMO_ROWS, measured, met, strict=True)]


def _installed_bytes() -> int:
    """The files of every package that this Python finds."""
    files = {Path(str(file.locate())) for package in importlib.metadata.distributions()
             for file in package.files or ()}
    return sum(file.stat().st_size for file in files if file.is_file())


def _processor_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
