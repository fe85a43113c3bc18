"""Every command in the README, run unchanged on files made for it."""

import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.table import Asked, Row, Setting

README = Path(__file__).parents[2] / "README.md"
_AT_A_ROBOT = ("virtual-robot", "robot", "record", "execute")
"""They need a controller and a cell; `scripts/bench robot` has them."""
_SECONDS = 600
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
            done = _limber(folder, *shlex.split(line)[1:])
            if done.returncode != 0:
                failed.append(line)
                print(f"{line}: exit {done.returncode}: {(done.stderr or done.stdout)[-400:]}")
    told = f"{count - len(failed)} of {count}; {len(lines) - len(chosen)} want a robot"
    if count < len(chosen):
        told += f"; no time for {len(chosen) - count} more"
    is_met = False if failed else True if count == len(chosen) else None
    return [Row(*README_ROW, told, is_met, count)]


def _limber(folder: Path, *words: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-m", "limber", *words], cwd=folder, text=True,
                          capture_output=True, check=False, timeout=_SECONDS)


def _required(folder: Path, *words: str) -> None:
    done = _limber(folder, *words)
    if done.returncode != 0:
        raise RuntimeError(f"limber {' '.join(words)}: {done.stderr[-400:]}")


def _scan(folder: Path, seed: int) -> None:
    _required(folder, "generate", "scanned", "--seed", str(seed % 1000))
    shutil.copyfile(folder / "scanned" / "cloud.ply", folder / "scan.ply")


def _recording(folder: Path, seed: int) -> None:
    _required(folder, "virtual-pull", "apple.branch", "--name", "made", "--seed", str(seed % 1000))
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
