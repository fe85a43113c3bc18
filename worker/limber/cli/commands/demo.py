"""Run the whole pipeline on one branch."""

import json
import shlex
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from limber.cli.terminal import closing_lines, table_text
from limber.core.errors import (
    Cancelled,
    Command,
    InputError,
    LimberError,
    MissingDependencyError,
    Option,
    Text,
)
from limber.core.files.atomic import write_atomically
from limber.core.files.reading import read_json
from limber.core.optional import require_extra
from limber.core.processes.child import run_stage
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups
from limber.geometry.settings import ReconstructSettings
from limber.stages.command_line import command_line, without_foreign_options
from limber.stages.registry import stage_class
from limber.stages.shape.reconstruct import Reconstruct
from limber.stages.stage import About, Stage, argument, given, option
from limber.store import Branch
from limber.store.manifest import MANIFEST, Manifest
from limber.version import VERSION

# Assumed Young's modulus [Pa] at the control points for the simulated pull on a scan without a
# recording: green wood that softens towards the tip.
DEMO_YOUNG = (2.0e9, 1.6e9, 1.2e9, 0.8e9)

# The generated branch bends by a third of a metre under 0.2 N: its force sensor is made for that. A
# robot's own one, with a zero to 1 N, would tell nothing of it.
_SMALL_SENSOR = "[calibration]\nforce_bias_sigma_n = 0.01\nforce_drift_sigma_n = 0.01\n"

# Fraction of the whole time at which each stage ends, for the bar; measured once, only approximate.
_ENDS = {"generate": 0.01, "reconstruct": 0.15, "virtual-pull": 0.3, "estimate": 0.5,
         "simulate": 0.55, "energy": 0.8, "plan": 0.92, "report": 0.95, "scene": 1.0}


_FILES = ("report", "scene", "picture")


@dataclass
class _Demo:
    """A demo in progress: its folder and the results of its stages, by command."""

    folder: Path
    branch: Path
    progress: Progress
    own: frozenset[str]
    """The demo's options."""
    reports: bool
    """Whether the packages of the report are installed."""
    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    kept: set[str] = field(default_factory=set)
    """Stages with results from an earlier demo."""
    done: float = 0.0

    def stage(self, title: str, *arguments: object) -> None:
        """Run one stage as a process; show its progress and duration; keep its result."""
        name = str(arguments[0])
        started = time.perf_counter()
        progress = self.progress.part(self.done, _ENDS[name])
        progress(0.0, title)
        before = self._entries()
        try:
            result = run_stage([str(a) for a in arguments], progress)
        except LimberError as error:
            raise self._in_own_words(name, error) from error
        self.done = _ENDS[name]
        self.seconds[name] = round(time.perf_counter() - started, 1)
        self.results[name] = result
        if before and before == self._entries() and stage_class(name).about.key:
            self.kept.add(name)
        self._tell(title, name)
        for warning in result.get("warnings", []):
            if text := without_foreign_options(Text(warning), self.own):
                self.progress.warn(f"{name}: {text}")

    def show(self) -> None:
        """Write the report, then scene and picture, unless they show the current branch; the report
        needs no Blender, and gets the picture once there is one."""
        title, note = "a scene and its picture", self.folder / "demo.json"
        origin = {"branch": self._digest(), "limber": VERSION}
        scene, picture = self.folder / "scene.blend", self.folder / "scene.png"
        if scene.is_file() and picture.is_file() and _read_note(note) == origin:
            self.kept.add("scene")
        pictured = ["report", self.branch, "--picture", picture]
        if self.reports:
            self.stage("the report", *pictured[:4 if "scene" in self.kept else 2])
        if "scene" in self.kept:
            self.seconds["scene"], self.done = 0.0, _ENDS["scene"]
            self._tell(title, "scene")
            return
        try:
            self.stage(title, "scene", self.branch, "-o", scene, "--render", picture)
        except Cancelled:
            raise
        except LimberError as error:
            self.progress.warn(f"There is no scene and no picture: {error}")
            return
        if self.written()["scene"] != scene:
            return  # Without Blender; the next demo tries again.
        write_atomically(note, json.dumps(origin) + "\n")
        if self.reports:
            run_stage([str(word) for word in pictured], self.progress.part(1.0, 1.0))

    def written(self) -> dict[str, Path | None]:
        """Return the paths of report, scene and picture, as far as this demo has them."""
        shown = "scene" in self.kept or "scene" in self.results
        paths = (self.branch / "report.html", Path(self.results.get("scene", {}).get(
            "scene", self.folder / "scene.blend")), self.folder / "scene.png")
        return {name: path if made else None for name, path, made in zip(
            _FILES, paths, (self.reports, shown, shown), strict=True)}

    def _tell(self, title: str, name: str) -> None:
        duration = "kept" if name in self.kept else f"{self.seconds[name]:.1f} s"
        self.progress.say(f"  {title:<42} {duration:>8}")

    def _entries(self) -> dict[str, str]:
        """Return when each stage of the branch was finished, by its entry."""
        manifest = self._manifest()
        return {} if manifest is None else {
            key: entry.finished for key, entry in manifest.stages.items()}

    def _digest(self) -> str | None:
        manifest = self._manifest()
        return None if manifest is None else manifest.content_digest()

    def _manifest(self) -> Manifest | None:
        is_written = (self.branch / MANIFEST).is_file()
        return Branch.read(self.branch).manifest if is_written else None

    def _in_own_words(self, name: str, error: LimberError) -> LimberError:
        """Return a stage's error without advice on options that only the stage has."""
        seen, why, fix = (without_foreign_options(part, self.own)
                          for part in (error.seen, error.why, error.fix))
        if (seen, why, fix) == (error.seen, error.why, error.fix):
            return error
        return type(error)(seen or f"{name} failed.", why, fix + " " * bool(fix), Command(name),
                           " has more options than the demo. Run it on the results in "
                           f"{self.folder}.")


def _end(values: Mapping[str, Any]) -> str:
    """What was found, where the results are, and what to type next."""
    if values["robot"]:
        then = ""
    elif values["cloud"] is None:
        then = "limber demo SCAN.ply   (your own scan)"
    else:
        then = (f"limber import-pull {shlex.quote(values['branch'])} PULL --name NAME   (a pull "
                "that you measured)")
    files = [f"{name:<8}{values[name]}" for name in _FILES if values[name] is not None]
    return "\n".join(closing_lines([*values["found"], *files], then=then))


class Demo(ReconstructSettings, Stage):
    """The whole pipeline on one branch: a generated one with known truth, or your CLOUD with a
    simulated pull, whose modulus is assumed."""

    about = About("demo", where="", found=(_end,))
    groups: ClassVar[Groups] = {"demo": ("young",)}
    cloud: Path | None = argument("Your scan of one branch.", default=None, group="demo")
    output: Path | None = given("Folder of the results. Default: out/NAME.", group="demo",
                                common=True, short="-o")
    skeleton: Path | None = given(
        "Your own skeleton in the cloud's coordinates, as of `limber reconstruct`.", group="demo",
        common=True)
    edits: Path | None = given("Edits of the skeleton, as of `limber skeleton`.", group="demo",
                               common=True)
    goal: tuple[float, float, float] | None = given(
        "Goal position of the grasp, in the branch's frame [m]. Default: a place for the "
        "branch's tip, some centimetres away.", group="demo", common=True)
    young: tuple[float, ...] = Field(  # type: ignore[assignment]
        DEMO_YOUNG, json_schema_extra={"metavar": "A,B,C,D", "common": True}, description=(
            "Assumed Young's modulus [Pa] at the control points of your CLOUD's pull."))
    seed: int = option("Seed of the generated branch, the sensor noise and the planner.", 1,
                       group="demo", common=True)
    force: bool = option("Reconstruct again even if nothing has changed.", False, switch=True,
                         group="demo", common=True)
    robot: bool = option("Run the closed loop instead, with a virtual robot that scans, pulls and "
                         "moves a generated branch.", False, switch=True, group="demo",
                         common=True)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        cloud = self.cloud
        if self.robot:
            return _closed_loop(self, self.output or Path("out") / "robot", progress)
        if cloud is not None and not cloud.is_file():
            raise InputError(f"There is no file {cloud}.", "The demo needs the scan of one "
                             "branch.", "Name a PLY, XYZ, TXT, CSV, PCD or LAS file, or none at "
                             "all.")
        name = cloud.stem if cloud else "generated"
        folder = self.output or Path("out") / name
        demo = _Demo(folder, folder / f"{name}.branch", progress,
                     frozenset(str(Option(name)) for name in self.names()), _has_report(progress))
        _make_folder(demo.folder)
        started = time.perf_counter()
        progress.say(f"Limber demo on {cloud or 'a generated branch'}, results in {demo.folder}")
        if cloud is not None:
            progress.say("The pull is simulated with an assumed Young's modulus (--young). The "
                         "stiffness of this branch was not measured.")
        failure = _run_stages(demo, self)
        demo.show()
        _show_tables(demo)
        summary = _summary(demo) | {"demo_seconds": round(time.perf_counter() - started, 1)}
        if failure is not None:
            if demo.reports:
                progress.say(f"The report has what was found before: {summary['report']}")
            raise failure
        return summary | {"found": _found(demo)}


def _has_report(progress: Progress) -> bool:
    """Whether a report can be written; a warning with the remedy, before minutes of work."""
    try:
        require_extra("report", ("matplotlib", "jinja2"), "The demo's report")
    except MissingDependencyError as error:
        progress.warn(f"There will be no report: {error}")
        return False
    return True


def _closed_loop(asked: Demo, folder: Path, progress: Progress) -> dict[str, Any]:
    if asked.cloud is not None:
        raise InputError(Text(Option("robot"), f" was given with the scan {asked.cloud}."),
                         "The virtual robot scans a generated branch.", "Omit one of them.")
    require_extra("robot", ("rtde_control", "rtde_io"), "The virtual robot's client")
    reports = _has_report(progress)
    from limber.cli.closed_loop.comparison import comparison
    from limber.cli.closed_loop.loop import ClosedLoop

    started = time.perf_counter()
    progress.say(f"Limber demo with a virtual robot, results in {folder}")
    result = ClosedLoop(folder, asked.seed, progress=progress).run()
    for title, rows in comparison(result):
        progress.say(table_text(title, rows))
    demo = _Demo(folder, Path(result["branch"]), progress, frozenset(), reports, done=_ENDS["plan"])
    demo.show()
    return result | demo.written() | {"demo_seconds": round(time.perf_counter() - started, 1),
                                      "found": [_loop_sentence(result)]}


def _run_stages(demo: _Demo, asked: Demo) -> LimberError | None:
    """Run all stages up to the plan; a failure after the mesh still ends in a report. Return those
    that failed."""
    branch, cloud, seed = demo.branch, asked.cloud, asked.seed
    truth: tuple[str, ...] = ()
    errors = "realistic"
    if cloud is None:
        source = demo.folder / "scan"
        demo.stage("a generated branch, scanned", "generate", source, "--seed", seed)
        cloud = source / "cloud.ply"
        errors = str(demo.folder / "sensor.toml")
        Path(errors).write_text(_SMALL_SENSOR, encoding="utf-8")
    else:
        truth = ("--young", ",".join(map(str, asked.young)))
    # All but the output and the assumed moduli is as the reconstruction takes it.
    known = asked.model_fields_set & Reconstruct.model_fields.keys() - {"output", "young"}
    scan = Reconstruct(**{name: getattr(asked, name) for name in known}
                       | {"cloud": cloud, "output": branch})
    demo.stage("scan to tetrahedra", "reconstruct", *command_line(scan))
    failure = None
    try:
        demo.stage("a simulated pull, with noise and the errors of a cell", "virtual-pull", branch,
                   "--name", "pull-1", "--seed", seed, "--cell-errors", errors,
                   "--model", "rod", *truth)
        demo.stage("Young's modulus from the pull", "estimate", branch)
        demo.stage("a pull with the estimated modulus", "simulate", branch)
        demo.stage("energy over grasp poses", "energy", branch, "--seed", seed)
        goal = _tip_goal(branch) if asked.goal is None else ["--goal", *asked.goal]
        demo.stage("the gentlest path and the shortest", "plan", branch, "--name", "to-goal",
                   "--seed", seed, *goal)
    except Cancelled:
        raise
    except LimberError as error:
        failure = error
        demo.progress.warn(f"{error} Report and scene show the results so far.")
    return failure


def _tip_goal(branch: Path) -> list[object]:
    """A place some centimetres from the branch's tip, as options of `limber plan`."""
    from limber.planning.field.energy_field import EnergyField
    from limber.planning.goals.goal_kinds import tip_goal

    goal = tip_goal(EnergyField.read(branch / "energy.npz"))
    return ["--tip-goal", *goal.region.middle.tolist(), "--goal-tolerance", goal.tolerance]


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be made ({error.strerror}).", "Results go there.",
                         "Choose another folder with -o.") from error


def _show_tables(demo: _Demo) -> None:
    from limber.results.report.report_tables import held_sentence, modulus_rows
    from limber.stages.paths.plan import Plan

    if "estimate" in demo.results:
        estimate, pull = demo.results["estimate"], demo.results["virtual-pull"]
        demo.progress.say(table_text("Young's modulus", modulus_rows(estimate, pull)))
        demo.progress.say(held_sentence(estimate, pull))
    if "plan" in demo.results:
        demo.progress.say(table_text("Paths", Plan.of(demo.results["plan"]).comparison()))


def _found(demo: _Demo) -> list[str]:
    """The demo's findings, in the sentences of its stages."""
    from limber.stages.paths.plan import Plan
    from limber.store import Branch

    sentences = Plan.of(demo.results["plan"]).sentences(Branch.read(demo.branch))
    if demo.kept:
        kept = "All results" if not demo.results.keys() - demo.kept - {"generate"} else (
            f"Results of {', '.join(sorted(demo.kept))}")
        sentences.append(f"{kept} were kept from an earlier demo. --force reconstructs again.")
    return sentences


def _loop_sentence(result: Mapping[str, Any]) -> str:
    held = sum(result["covered"])
    flower = ("was brought to its goal" if result["flower_in_goal"] else "did not reach its goal")
    return (f"{held} of {len(result['covered'])} intervals contain the true modulus; the flower "
            f"{flower}; the force along the path was within 5 % of the peak, or its interval, on "
            f"{100 * result['force_within_share']:.1f} % of it.")


def _read_note(path: Path) -> Any:
    """Return the record of an earlier demo; None if there is none, or it is damaged."""
    try:
        return read_json(path, "a demo's note")
    except InputError:
        return None


def _summary(demo: _Demo) -> dict[str, Any]:
    return {
        "branch": demo.branch, **demo.written(),
        "stage_seconds": demo.seconds,
        "young_pa": demo.results.get("estimate", {}).get("young_pa"),
        "energy_saved_percent": demo.results.get("plan", {}).get("energy_saved_percent"),
        "length_added_percent": demo.results.get("plan", {}).get("length_added_percent"),
    }
