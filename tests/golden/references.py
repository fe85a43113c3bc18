"""What the references keep: of each stage its result, what it says and the files it writes.

Each case runs command lines on a fresh copy of the example branch and keeps what the last gave.
Of files and long lists the reference keeps the text without its numbers as a digest, and of the
numbers how many they are, the least, the greatest, the mean and a mean with weights that change
from number to number. `scripts/make_golden` writes the references anew; git shows what changed.
"""

import contextlib
import hashlib
import io
import json
import os
import re
import shutil
import struct
import sys
import tempfile
from pathlib import Path
from unittest.mock import patch

import numpy as np

from limber.cli.main import call

HERE = Path(__file__).parent
EXAMPLE = HERE.parents[1] / "blend_files" / "bending_branch"
STAGES = {
    "generate": "generate scan --seed 3 --length 0.3 --fork-count 1 --point-spacing 0.005",
    "reconstruct": "reconstruct a.branch/cloud.ply -o new.branch --mesh-spacing 4",
    "skeleton": "skeleton a.branch",
    "skeleton-edited": "skeleton a.branch --edits edits.json --frame branch",
    "mesh-sections": "mesh sections.csv -o new.branch",
    "mesh-cylinders": "mesh a.branch/skeleton.swc -o new.branch",
    "target": "target a.branch flower --at 0 0 0.2",
    "simulate": "simulate a.branch --move 0.02 0 0",
    "simulate-static": "simulate a.branch --grasp-force 0.1 0 0 --kind static --no-gravity",
    "load": "load a.branch --wind 5 0 0 --snow 2 --fruit -0.05 0 0.2 0.05 --name storm",
    "import-pull": "import-pull a.branch a.branch/pulls/pull-1 --name again",
    "virtual-pull": "virtual-pull a.branch --name other --seed 1 --cell-errors realistic "
                    "--frames 8",
    "export-pull": "export-pull a.branch --name pull-1 --mcap pull.mcap",
    "estimate": "estimate a.branch --force",
    "swing": "import-pull a.branch swing.csv --name swing --motion swing --weight 0.02 "
             "--grasp-distance 0.3 && swing a.branch",
    "vibration": "vibration a.branch ring.csv",
    "predict": "predict a.branch --weight 0.5",
    "suggest-pull": "suggest-pull a.branch --plan to-goal --fractions 0.8",
    "energy": "energy a.branch --force --samples 30",
    "plan": "plan a.branch --name new",
    "plan-limits": "plan a.branch --name new --max-force 1.9 "
                   "--goal -0.054 0.043 0.267 --max-strain 0.02",
    "compare": "compare a.branch --trials 1 "
               "--goal -0.056 0.046 0.266",
    "execute": "execute a.branch --name to-goal --cell cell.toml --unwatched "
               "--gripper-rotation 1.4096 -1.2795 -0.8176",
    "report": "report a.branch",
    "scene": "scene a.branch -o a.blend",
} | {f"export-{suffix}": f"export a.branch -o a.{suffix}"
     for suffix in ("xml", "urdf", "inp", "usda", "swc", "csv", "mtg", "mat")}
WRONG = (HERE / "wrong.txt").read_text(encoding="utf-8").splitlines()
PRINTS = ("reconstruct", "mesh-cylinders", "target", "load", "estimate", "predict", "energy",
          "plan")
"""Stages whose last lines for people are kept as well: they find all done the second time."""

OF_THE_RUN = {"seconds", "plan_seconds", "check_seconds", "peak_memory_mb", "uuid",
              "cloud_sha256", "blender",
              # These follow the last digits, which differ by processor: two postures tie.
              "history", "forward_count", "joint_limit_margin_rad", "start_joints_rad"}
CLOCK = re.compile(r"done in [\d.]+ s|\d{4}-\d\d-\d\d[T \d:]*")
IS_PROGRESS = re.compile(r"[\w-]+: \d+ s, \d+ %")
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
LONG = 160


def stage_reference(name: str) -> dict:
    """Run a case's commands; returns result, messages and files of the last."""
    with _workplace():
        *before, command = STAGES[name].split(" && ")
        for each in before:
            _run(each)
        known = _files()
        code, out, said = _run(command, "--json")
        files = {str(path): digest(path) for path, content in sorted(_files().items())
                 if known.get(path) != content and not path.name.startswith(".")
                 and path.suffix != ".blend" and not path.stem.endswith("-preview")}
        found = {"command": command, "code": code, "result": shortened(json.loads(out[-1])),
                 "said": said, "files": files}
        if name in PRINTS:
            found["prints"] = _run(command.replace("--force ", ""))[1]
        return _without_places(found)


def error_reference() -> dict[str, dict]:
    """What each wrong command line of `wrong.txt` ends with, and says."""
    found = {}
    for command in WRONG:
        with _workplace():
            code, out, said = _run(command, "--json")
            told = json.loads(out[-1]) if out and out[-1].startswith("{") else {}
            found[command] = _without_places({"code": code} | {
                name: shortened(told[name])
                for name in ("status", "error", "fix", "remedies", "place")
                if told.get(name)} | ({} if told else {"said": said}))
    return found


def help_reference() -> dict[str, list[str]]:
    """The help of each command that no schema describes."""
    import click

    from limber.cli.main import command_summaries, main
    from limber.stages.registry import stage_summaries

    found = {}

    def add(command: click.Command, words: str) -> None:
        if isinstance(command, click.Group):
            for name in command.list_commands(click.Context(command)):
                add(command.get_command(click.Context(command), name), f"{words} {name}")
        found[words] = sorted(
            " ".join(["/".join([*each.opts, *each.secondary_opts]),
                      each.type.name + ("" if each.nargs == 1 else f" x {each.nargs}"),
                      repr(each.to_info_dict().get("default")),
                      getattr(each, "help", None) or ""]) for each in command.params)
        found[words].insert(0, command.help or "")
    for name in sorted(set(command_summaries()) - set(stage_summaries())):
        add(main.get_command(click.Context(main), name), name)
    return found


def python_reference() -> dict[str, dict]:
    """Attributes and tables of the example's results in the Python interface."""
    import limber

    with _workplace():
        branch = limber.open("a.branch")
        return _without_places({key: {
            "type": type(result).__name__, "shows": repr(result), "html": result._repr_html_(),
            "table": shortened(result.table()) if hasattr(result, "table") else None,
            "values": shortened({name: value for name, value in vars(result).items()
                                 if not name.startswith("_") and name != "values"})}
            for key, result in branch.results.items()})


@contextlib.contextmanager
def _workplace():
    """A folder to work in with the example and other inputs."""
    at = Path.cwd()
    with (tempfile.TemporaryDirectory() as folder, small_parts(),
          patch.dict(os.environ, LIMBER_CORES="1")):
        os.chdir(folder)
        try:
            shutil.copytree(EXAMPLE, "a.branch")
            shutil.copy(HERE / "cell.toml", ".")
            times = np.arange(0.0, 4.0, 0.01)
            ringing = np.exp(-0.5 * times) * np.cos(19.0 * times)
            np.savetxt("ring.csv", np.c_[times, ringing], delimiter=",", comments="",
                       header="time_s,acceleration")
            axis = np.loadtxt("a.branch/skeleton.swc")[:, 2:5]
            places = axis[[len(axis) // 3, len(axis) // 2]]
            sag = np.where(times > 0.5, 1 - np.cos(19 * (times - 0.5)) * np.exp(0.5 - times), 0)
            moved = places + sag[:, None, None] * np.array([[0, 0, -4e-4], [0, 0, -8e-4]])
            np.savetxt("swing.csv", np.c_[times, moved.reshape(len(times), 6)], delimiter=",",
                       comments="", header="t_s," + ",".join(
                           f"m{marker}_{axis}_m" for marker in "12" for axis in "xyz"))
            Path("edits.json").write_text(json.dumps(
                [{"do": "radius", "at": places[0].tolist(), "radius": 0.006}]))
            Path("broken.ply").write_bytes(Path("a.branch/cloud.ply").read_bytes()[:300])
            Path("ten.xyz").write_text("".join(f"0 0 {k / 10}\n" for k in range(10)))
            Path("job.toml").write_text("stages = 3\n")
            Path("sections.csv").write_text("x,y,z,width,height\n" + "".join(
                f"{k / 50},0,0,{0.012 - k / 5000},0.01\n" for k in range(11)))
            yield
        finally:
            os.chdir(at)


@contextlib.contextmanager
def small_parts():
    """Every part of a stage, of few frames, shapes, samples and cells; pictures without pixels."""
    from matplotlib import pyplot

    from limber.estimation.settings import FitSpec
    from limber.planning.settings import Effort, PlanSettings

    usual = FitSpec.of.__func__

    def of(cls, settings):
        found = usual(cls, settings)
        return found if found.quick else found.model_copy(update={"key_frames": 5, "shapes": 8})

    with (patch.object(FitSpec, "of", classmethod(of)),
          patch.object(PlanSettings, "effort", Effort(iterations=200)),
          patch("limber.planning.certificate.lower_bound._MOST_CELLS", 60_000),
          patch("limber.results.report.section._png", lambda figure: pyplot.close(figure) or b"")):
        yield


def _run(command: str, *more: str) -> tuple[int, list[str], list[str]]:
    out, said = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        code = call([*command.split(), *more])
    return code, out.getvalue().splitlines(), [
        line for line in said.getvalue().splitlines() if not IS_PROGRESS.match(line)]


def _files() -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in Path().rglob("*")
            if path.is_file() and path.name != "branch.json"}


def _without_places(value):
    """Paths of the folder to work in, times and marks of the run are left out."""
    text = json.dumps(value).replace(str(Path.cwd().resolve()), "HERE").replace(
        str(Path.cwd()), "HERE")
    return json.loads(CLOCK.sub("#", text))


def digest(path: Path) -> dict:
    """What is kept of a file: of each array and text in it."""
    suffix = path.suffix
    if suffix == ".json":
        return shortened(json.loads(path.read_text(encoding="utf-8")))
    if suffix == ".npz":
        with np.load(path) as arrays:
            return {name: _array(arrays[name]) for name in sorted(arrays.files)}
    if suffix == ".mat":
        from scipy.io import loadmat

        return {name: str(np.shape(value)) for name, value in sorted(loadmat(path).items())
                if not name.startswith("__")}
    if suffix == ".vtu":
        import meshio

        mesh = meshio.read(path)
        arrays = {"points": mesh.points, **mesh.point_data}
        arrays |= dict(mesh.cells_dict)
        arrays |= {f"{name} {n}": part for name, parts in mesh.cell_data.items()
                   for n, part in enumerate(parts)}
        return {name: _array(np.asarray(array)) for name, array in sorted(arrays.items())}
    if suffix == ".ply":
        from plyfile import PlyData

        return {f"{part.name} {each.name}": _array(np.stack(part[each.name]))
                for part in PlyData.read(path).elements for each in part.properties}
    if suffix == ".pc2":
        content = path.read_bytes()
        return {"head": list(struct.unpack("<12siiffi", content[:32])[1:]),
                "frames": _array(np.frombuffer(content[32:], "<f4"))}
    if suffix == ".html":
        shown = re.sub(r"(?s)<(style|script|svg).*?</\1>|<[^>]*>", "\n", path.read_text("utf-8"))
        return {"shows": [line.strip() for line in shown.splitlines() if line.strip()]}
    try:
        return _text(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError:
        return {"bytes": path.stat().st_size}


def shortened(value):
    """A result or JSON file, numbers rounded, with what is long in it as a digest."""
    if isinstance(value, np.ndarray):
        return _array(value)
    if hasattr(value, "_asdict") or not isinstance(value, dict | list | tuple | str | int | float
                                                   | bool | None):
        return re.sub(r" at 0x\w+", "", repr(value)) if not hasattr(value, "items") else \
            shortened(dict(value))
    if isinstance(value, dict):
        return {name: shortened(each) for name, each in value.items() if name not in OF_THE_RUN}
    if isinstance(value, float):
        return float(f"{value:.9g}")
    if isinstance(value, list | tuple):
        text = json.dumps(_lasting(value), default=str)
        return [shortened(each) for each in value] if len(text) < LONG else _text(text)
    return value


def _lasting(value):
    """The same without what is of the run."""
    if isinstance(value, dict):
        return {name: _lasting(each) for name, each in value.items() if name not in OF_THE_RUN}
    return [_lasting(each) for each in value] if isinstance(value, list | tuple) else value


def _text(text: str) -> dict:
    text = CLOCK.sub("", text)
    numbers = np.array([float(each) for each in NUMBER.findall(text)])
    words = hashlib.sha256(NUMBER.sub("#", text).encode()).hexdigest()[:12]
    return {"text": words, "lines": text.count("\n"), "numbers": _array(numbers)}


def _array(array: np.ndarray) -> list:
    """Shape, least, greatest, mean and a mean with changing weights; of texts a digest."""
    if array.dtype.kind not in "fiub":
        return _text(" ".join(map(str, array.ravel().tolist())))
    flat = array.ravel().astype(float)
    flat = flat[np.isfinite(flat)]
    if not len(flat):
        return [list(array.shape)]
    weights = np.cos(np.arange(len(flat)) * 0.7)
    return [list(array.shape), *(float(f"{each:.9g}") for each in (
        flat.min(), flat.max(), flat.mean(), (weights * flat).mean()))]


ALL = {f"stages/{name}": lambda name=name: stage_reference(name) for name in STAGES} | {
    "errors": error_reference, "commands": help_reference, "python": python_reference}


def written(reference: dict) -> str:
    """A reference as text: short lists in one line."""
    text = json.dumps(reference, indent=1, ensure_ascii=False)
    return re.sub(r"\[([^\[\]{}\"]{1,300})\]", lambda found: f"[{' '.join(found[1].split())}]",
                  text) + "\n"


def main(names: list[str]) -> None:
    """Write the references anew: all, or those whose names begin so."""
    chosen = [name for name in ALL if not names or any(
        name.removeprefix("stages/").startswith(each) for each in names)]
    if not chosen:
        sys.exit(f"No reference's name begins with {' or '.join(names)}.")
    for name in chosen:
        path = HERE / f"{name}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(written(ALL[name]()), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
