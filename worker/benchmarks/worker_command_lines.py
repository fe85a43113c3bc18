"""Command lines with options of any value, as people and scripts write them.

A file of the fuzz is a command line as a JSON list; ``{branch}`` stands for a copy of the template,
``{out}`` for an empty folder, ``{in}`` for a folder with inputs. The command runs in the reading
process. It must end with one of the documented exit codes, and a message.
"""

import contextlib
import io
import json
import os
import shutil
import tempfile
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.worker_branch_readers import Reader
from limber.core.errors import InputError
from limber.stages.registry import stage_schema, stage_summaries

_LINES: dict[str, list[list[str]]] = {
    "predict": [["predict", "{branch}", "--weight", "0.1"]],
    "import-pull": [
        ["import-pull", "{branch}", "{in}/markers.csv", "--name", "p", "--robot", "{in}/robot.csv",
         "--unit", "m", "--time-offset", "0"],
        ["import-pull", "{branch}", "{in}/robot.csv", "--name", "p"]],
    "mesh": [["mesh", "{in}/branch.swc", "-o", "{out}/a.branch", "--unit", "m"]],
    "skeleton": [["skeleton", "{branch}"]],
    "target": [["target", "{branch}", "fruit", "--at", "-0.056", "-0.033", "0.285", "--mass",
                "0.1"]],
    "vibration": [["vibration", "{branch}", "{in}/ring.csv"]],
    "export": [["export", "{branch}", "-o", "{out}/b.urdf"],
               ["export", "{branch}", "-o", "{out}/b.swc"]],
    "scene": [["scene", "{branch}", "--data", "{out}/s.npz"]],
    "others": [["verify", "{branch}"], ["bug-report", "{branch}", "-o", "{out}/b.zip"],
               ["status", "{in}/jobs.toml"], ["batch", "{in}/jobs.toml"],
               ["robot", "check", "{in}/cell.toml"]]}
"""Commands that take well under ten seconds with the values here. None moves a robot, or removes
files other than its own; `limber cache` does.
"""
_CODES = (0, 2, 3, 4, 130)
_OWN = ("--json", "--progress", "--help", "--help-all", "--schema", "-o", "--data", "--clear")


def _lines(name: str, _template: Path, folder: Path) -> list[Path]:
    files = []
    for number, line in enumerate(_LINES[name]):
        files.append(folder / f"{name}-{number}.json")
        files[-1].write_text(json.dumps(line))
    return files


@cache
def _options(name: str) -> list[tuple[str, Any]]:
    """Options of a stage's settings, and their defaults."""
    if name not in stage_summaries():
        return []
    return [(f"--{key.replace('_', '-')}", about.get("default"))
            for key, about in stage_schema(name)["settings"]["properties"].items()]


def with_further_option(line: list[str], rng: np.random.Generator) -> list[str]:
    """Add an option of the command to a line, with its default or a number in its place."""
    options = _options(line[0]) if line else []
    if not options:
        return line
    option, default = options[int(rng.integers(len(options)))]
    if isinstance(default, bool) or default is None:
        return [*line, option] if isinstance(default, bool) else [*line, option, "1"]
    values = default if isinstance(default, list | tuple) else [default]
    return [*line, option, *map(str, values)]


def _run(template: Path, path: Path) -> Any:
    from limber.cli.main import call

    try:
        line = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError("no command line", "", "") from error
    if not isinstance(line, list) or not all(isinstance(word, str) for word in line) or not line:
        raise InputError("no command line", "", "")
    with tempfile.TemporaryDirectory(prefix="limber-line-") as place:
        words = [_filled(word, template, Path(place)) for word in line]
        told, result = io.StringIO(), io.StringIO()
        back = os.getcwd()
        os.chdir(place)
        try:
            with contextlib.redirect_stderr(told), contextlib.redirect_stdout(result):
                code = call([*words, "--json"])
        finally:
            os.chdir(back)
    if code not in _CODES or "Traceback" in told.getvalue() or "internal" in told.getvalue():
        raise RuntimeError(f"{code} of {line}: {told.getvalue()[-300:]}")
    last = (result.getvalue().strip().splitlines() or ["{}"])[-1]
    content = json.loads(last) if last.startswith("{") else {}
    if code:
        raise InputError(str(content.get("error") or told.getvalue() or "refused"), "", "")
    return content


def _filled(word: str, template: Path, place: Path) -> str:
    """A word with its placeholders filled; their files are made when they are first named."""
    if "{branch}" in word and not (place / "a.branch").exists():
        shutil.copytree(template, place / "a.branch")
    if "{in}" in word and not (place / "in").exists():
        _inputs(template, place / "in")
    (place / "out").mkdir(exist_ok=True)
    for name, folder in (("branch", "a.branch"), ("in", "in"), ("out", "out")):
        word = word.replace(f"{{{name}}}", str(place / folder))
    return word


def _inputs(template: Path, folder: Path) -> None:
    folder.mkdir()
    pull = template / "pulls" / "pull-1"
    for name in ("markers.csv", "robot.csv"):
        shutil.copyfile(pull / name, folder / name)
    shutil.copyfile(template / "skeleton.swc", folder / "branch.swc")
    times = np.arange(0, 4, 0.02)
    np.savetxt(folder / "ring.csv", np.column_stack(
        [times, np.exp(-0.5 * times) * np.cos(30 * times)]), "%.5f", ",",
        header="time_s,a_m_s2", comments="")
    (folder / "jobs.toml").write_text('[[job]]\nscans = ["none*.xyz"]\n')
    (folder / "cell.toml").write_text('[robot]\nmodel = "none"\n')


LINE_READERS: dict[str, Reader] = {
    f"limber {name}": Reader("words", partial(_lines, name), _run, True) for name in _LINES}
"""By name."""
