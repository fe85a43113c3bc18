"""The worker's table: mutated files, start-up, first run, README, sizes.

Times are those of this computer under its load at the moment: ``--only two-cores`` needs it idle.
"""

import importlib.metadata
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np

import limber
from benchmarks import worker_batches as batches
from benchmarks import worker_fuzz
from benchmarks.estimation import RINGING, ringing_row
from benchmarks.table import Asked, Part, Row, Setting, last_json, limber_command
from benchmarks.worker_hostile import HOSTILE_ROWS, hostile
from limber.core.errors import LimberError
from limber.geometry.cloud import preparation
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.reconstruction import reconstruct_cloud
from limber.geometry.settings import ReconstructSettings

_START_UP = {"--help": Asked("limber --help, least of 5", "0.3 s"),
             "doctor": Asked("limber doctor, least of 5", "2.0 s")}
_START_UP_SECONDS = {"--help": 0.3, "doctor": 2.0}


def _start_up(_setting: Setting) -> list[Row]:
    found = []
    for word, asked in _START_UP.items():
        seconds = []
        for _ in range(5):
            started = time.perf_counter()
            limber_command(word).check_returncode()
            seconds.append(time.perf_counter() - started)
        found.append(Row(*asked, f"{min(seconds):.2f} s", min(seconds) <= _START_UP_SECONDS[word],
                         len(seconds)))
    return found


# --- a newcomer's first run ---------------------------------------------------------------------

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
        done = limber_command("demo", "-o", Path(place, "out"), "--json", "--progress", "none")
        done.check_returncode()
        seconds, spent = time.perf_counter() - began, _processor_seconds() - used
        found = last_json(done)
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


# --- every command of the README, run unchanged on files made for it ---------------------------

README = Path(__file__).parents[2] / "README.md"
_AT_A_ROBOT = ("virtual-robot", "robot", "record", "execute")
"""They need a controller and a cell; `scripts/bench robot` has them."""
_BEAM_MM = (30.0, 30.0, 120.0)
_YOUNG_PA, _DENSITY, _LOAD_N = 3e5, 1070.0, 0.51


def shown_commands(text: str) -> list[str]:
    """Return the lines of a README's code blocks that begin with limber, continued lines joined."""
    blocks = re.findall(r"^```(?:[a-z]*|\{run\})\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.split(" #")[0].strip() for line in lines if line.startswith("limber ")]


README_ROW = Asked("commands of the README, run as they stand", "all")


def run_readme(setting: Setting) -> list[Row]:
    """Run them one after the other in one folder; the inputs of each are made before it."""
    lines = shown_commands(README.read_text(encoding="utf-8"))
    chosen = [line for line in lines if shlex.split(line)[1] not in _AT_A_ROBOT]
    failed, count = [], 0
    with tempfile.TemporaryDirectory(prefix="limber-readme-") as place:
        folder = Path(place)
        for line in setting.budget.items(chosen):
            setting.progress(count / len(chosen), line[:60])
            count += 1
            for beginning, make in _MADE_BEFORE.items():
                if line.startswith(f"limber {beginning}"):
                    make(folder, setting.seed)
            done = limber_command(*shlex.split(line)[1:], folder=folder)
            if done.returncode != 0:
                failed.append(line)
                print(f"{line}: exit {done.returncode}: {(done.stderr or done.stdout)[-400:]}")
    told = f"{count - len(failed)} of {count}; {len(lines) - len(chosen)} want a robot"
    if count < len(chosen):
        told += f"; no time for {len(chosen) - count} more"
    is_met = False if failed else True if count == len(chosen) else None
    return [Row(*README_ROW, told, is_met, count)]


def _required(folder: Path, *words: object) -> None:
    done = limber_command(*words, folder=folder)
    if done.returncode != 0:
        raise RuntimeError(f"limber {' '.join(map(str, words))}: {done.stderr[-400:]}")


def _scan(folder: Path, seed: int) -> None:
    _required(folder, "generate", "scanned", "--seed", seed % 1000)
    shutil.copyfile(folder / "scanned" / "cloud.ply", folder / "scan.ply")


def _recording(folder: Path, seed: int) -> None:
    _required(folder, "virtual-pull", "apple.branch", "--name", "made", "--seed", seed % 1000)
    _required(folder, "export-pull", "apple.branch", "--name", "made", "--mcap", "recording.mcap")


def _beam(folder: Path, _seed: int) -> None:
    import trimesh

    box = trimesh.creation.box(_BEAM_MM)
    box.apply_translation(np.array(_BEAM_MM) / 2)
    box.export(folder / "beam.stl")


def _swing(folder: Path, _seed: int) -> None:
    """Markers on a cantilever lowered with a weight on it, by beam theory."""
    width, _, length = 1e-3 * np.array(_BEAM_MM)
    bending = _YOUNG_PA * width**4 / 12
    spread, at = _DENSITY * 9.81 * width**2, 0.1
    along = np.array([0.03, 0.06, 0.09, 0.118])
    rest = np.column_stack([[0.015, 0.02, 0.015, 0.02], np.full(4, width), along])
    near = np.minimum(along, at)
    sag = (spread * along**2 * (6 * length**2 - 4 * length * along + along**2) / (24 * bending)
           + _LOAD_N * near**2 * (3 * at - near) / (6 * bending)
           + _LOAD_N * at**2 / (2 * bending) * np.maximum(along - at, 0.0))
    times = np.arange(0.0, 12.0, 0.01)
    since = np.maximum(times - 1.0, 0.0)
    share = 1 - np.exp(-1.5 * since) * np.cos(12 * since)
    places = np.tile(rest, (len(times), 1, 1))
    places[:, :, 1] -= share[:, None] * sag
    names = ["a", "b", "c", "d"]
    head = ",".join(["t_s", *(f"{name}_{axis}_m" for name in names for axis in "xyz")])
    np.savetxt(folder / "swing.csv", np.column_stack([times, places.reshape(len(times), -1)]),
               "%.6f", ",", header=head, comments="")
    (folder / "markers.csv").write_text("label,x_m,y_m,z_m\n" + "".join(
        f"{name},{x},{y},{z}\n" for name, (x, y, z) in zip(names, rest, strict=True)))


def _ring(folder: Path, _seed: int) -> None:
    times = np.arange(0.0, 10.0, 0.01)
    values = np.exp(-0.4 * times) * np.cos(14 * times)
    np.savetxt(folder / "ring.csv", np.column_stack([times, values]), "%.5f", ",",
               header="time_s,a_m_s2", comments="")


_MADE_BEFORE: dict[str, Callable[[Path, int], None]] = {
    "reconstruct scan.ply": _scan, "import-pull apple.branch": _recording, "mesh beam.stl": _beam,
    "import-pull beam.branch": _swing, "vibration apple.branch": _ring}
"""Inputs of a command, by its first words."""


# --- scans of any size: memory and processor time ----------------------------------------------

_LIMITS = {15_000: (3.0, None), 100_000: (8.0, None), 1_000_000: (45.0, None),
           5_000_000: (150.0, 2.5), 50_000_000: (900.0, 4.0)}
"""Points: processor time [s], and peak memory [GB] if required."""
_QUICK = 1_000_000  # points
_LENGTH, _OFF = 1.29, 0.03  # of the branch [m], and what a result may be off
_PIECES, _PIECES_SECONDS = 2000, 20.0
_AT_ONCE = 1_000_000
_RUN = """
import json, resource, sys
from limber.stages.shape.reconstruct import Reconstruct
before = resource.getrusage(resource.RUSAGE_SELF)
result = Reconstruct(cloud=sys.argv[1], output=sys.argv[2]).run()
after = resource.getrusage(resource.RUSAGE_SELF)
print(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, after.ru_maxrss / 1e6,
      result["length_m"])
"""


def _size_asked(count: int) -> Asked:
    seconds, memory = _LIMITS[count]
    return Asked(f"a branch of {count:,} points: processor time" + (
        ", peak memory" if memory else ""), f"{seconds:.0f} s" + (
            f", {memory:g} GB" if memory else ""))


SMALL_ROW = Asked("branches of 60 to 250 points, bare and one-sided: neither a result nor a reason",
                  "0")
PIECES_ROW = Asked(f"{_PIECES:,} pieces without order: processor time", f"{_PIECES_SECONDS:.0f} s")
LARGE_ROWS = (SMALL_ROW, *map(_size_asked, _LIMITS), PIECES_ROW)


def large(setting: Setting) -> list[Row]:
    """Small scans, then larger and larger ones, as far as time allows."""
    found = [_small(setting)]
    counts = [count for count in _LIMITS if not setting.quick or count <= _QUICK]
    for count in setting.budget.items(counts):
        found.append(_sized(count, setting.seed))
    if setting.budget.remaining > 2 * _PIECES_SECONDS:
        found.append(_in_pieces(setting))
    return found


def branch(count: int, rng: np.random.Generator) -> np.ndarray:
    """Points [m] of a 1 m branch with a side branch of 0.29 m, in 0.3 mm of noise: [count, 3]."""
    along, angle = rng.random(count), 2 * np.pi * rng.random(count)
    radius = 0.01 * (1 - 0.5 * along)
    points = np.stack([0.05 * along**2 + np.cos(angle) * radius, np.sin(angle) * radius, along],
                      axis=1)
    x, y, z = points[:count // 4].T
    points[:count // 4] = np.stack([0.25 * z + 0.0125, 0.5 * y, 0.5 + 0.5 * x + 0.15 * z], axis=1)
    return points + rng.normal(scale=3e-4, size=points.shape)


def _small(setting: Setting) -> Row:
    bad, total = [], 0
    for seed in setting.seeds(10, 2):
        rng = np.random.default_rng(seed)
        for count in (60, 100, 150, 250):
            whole = branch(3 * count, rng)
            for points in (whole[::3], whole[whole[:, 1] > 0][:count]):
                total += 1
                try:
                    reconstruct_cloud(Cloud(points), ReconstructSettings())
                except LimberError:
                    continue
                except Exception as error:  # whatever it is: that is what is counted
                    bad.append(f"{count} points, seed {seed}: {type(error).__name__}")
    return Row(*SMALL_ROW, "; ".join([str(len(bad)), *bad[:3]]), not bad, total)


def _sized(count: int, seed: int) -> Row:
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        scan = Path(place, "branch.ply")
        _write(scan, count, np.random.default_rng(seed))
        run = subprocess.run([sys.executable, "-c", _RUN, scan, Path(place, "a.branch")],
                             capture_output=True, text=True, check=True)
    spent, peak, length = map(float, run.stdout.splitlines()[-1].split())
    seconds, memory = _LIMITS[count]
    is_met = spent <= seconds and peak <= (memory or np.inf) and abs(length - _LENGTH) < _OFF
    return Row(*_size_asked(count), f"{spent:.1f} s, {peak:.2f} GB, length {length:.3f} m for "
               f"{_LENGTH} m", is_met)


def _write(path: Path, count: int, rng: np.random.Generator) -> None:
    """A binary PLY file, piece by piece: the bench itself holds no large scan."""
    with open(path, "wb") as stream:
        stream.write((f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
                      + "".join(f"property float {axis}\n" for axis in "xyz")
                      + "end_header\n").encode())
        for start in range(0, count, _AT_ONCE):
            stream.write(branch(min(_AT_ONCE, count - start), rng).astype("<f4").tobytes())


def _in_pieces(setting: Setting) -> Row:
    """Clumps of six points strewn in a box: not a tree, which must be reported in time."""
    rng = setting.generator(1)
    centres = rng.uniform(-0.5, 0.5, (_PIECES, 1, 3))
    points = (centres + rng.normal(scale=1e-3, size=(_PIECES, 6, 3))).reshape(-1, 3)
    began = time.process_time()
    try:
        # The clumps are far apart, but no stray points.
        with mock.patch.object(preparation, "_OUTLIER_RATIO", np.inf):
            reconstruct_cloud(Cloud(points), ReconstructSettings(leaves="keep"))
        told = "a skeleton"
    except LimberError as error:
        told = f"refused: {error.seen}"
    seconds = time.process_time() - began
    return Row(*PIECES_ROW, f"{seconds:.1f} s; {told}", seconds <= _PIECES_SECONDS)


PARTS = {
    "hostile": Part(hostile, 60, HOSTILE_ROWS, grows=True),
    **worker_fuzz.PARTS,
    "start-up": Part(_start_up, 15, tuple(_START_UP.values())),
    "ringing": Part(ringing_row, 30, (RINGING,), grows=True),
    "demo": Part(run_demo, 90, DEMO_ROWS),
    "readme": Part(run_readme, 60, (README_ROW,), grows=True),
    "memory": Part(batches.memory, 30, (batches.MEMORY_ROW,), grows=True),
    "large": Part(large, 60, LARGE_ROWS, grows=True),
    "kills": Part(batches.killed, 90, (batches.KILLS_ROW,), grows=True)}
"""The table, in order of importance; ``--only`` also accepts the fuzz of one reader."""
