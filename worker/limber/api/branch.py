"""A branch folder and its operations, as a Python object.

All verbs work alike. Required arguments come first, without names; all others are the inputs,
settings and options of its command by name (``--mesh-spacing 4`` is ``mesh_spacing=4``), which
:func:`limber.settings` lists. ``quiet=True`` shows no progress. A verb runs its stage in this
process, writes the same files as the command, and returns a frozen result. Unchanged results are
not computed again. Errors are those of :mod:`limber.core.errors`; warnings are Python warnings.
"""

import contextlib
import html
import os
import sys
import tempfile
import threading
import types
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

import numpy as np

from limber.cli.known import command_class
from limber.core.errors import Command, InputError, LimberError, Option, Text
from limber.core.json_values import plain, stored
from limber.core.progress import BarSink, LineSink, Progress, Sink
from limber.core.settings import checked_settings, nearest
from limber.stages.registry import result_of
from limber.stages.result import Result, Written, drawn
from limber.stages.stage import Stage
from limber.store import Branch as Folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from limber.geometry.skeleton.alternatives import Alternative
    from limber.geometry.skeleton.skeleton import Skeleton
    from limber.geometry.tets.tet_mesh import TetMesh
    from limber.session.client import InteractiveSession
    from limber.stages.moduli.estimate import Estimate
    from limber.stages.motion.load import Load
    from limber.stages.motion.simulate import Simulation
    from limber.stages.paths.energy import EnergyField
    from limber.stages.paths.execute import Execution
    from limber.stages.paths.plan import Plan
    from limber.stages.pulls.import_pull import Pull
    from limber.stages.shape.generate import Generated

# Running a stage for a Python user: progress, warnings, and messages with Python names.

_STAGES = {"add_pull": "import-pull", "energy_field": "energy"}
_lock = threading.Lock()
_hidden: list[types.ModuleType] = []
"""The user's script, once for each stage that runs."""


def stage_of(verb: str) -> str:
    """Return the name of the command that a verb of the Python interface runs."""
    return _STAGES.get(verb, verb.replace("_", "-"))


def run_stage(name: str, arguments: Mapping[str, Any], *, quiet: bool) -> tuple[str,
                                                                                dict[str, Any]]:
    """Run a stage in this process.

    Args:
        name: Name of the stage.
        arguments: Its inputs, settings and options by name; arrays are accepted for lists.
        quiet: Show no progress.

    Returns:
        The name of its entry in the branch's manifest, empty if it makes none; and the output of
        its command with ``--json``, from ``warnings`` on.

    Raises:
        InputError: a name is not known, or a value is refused. LimberError: as for the stage.
    """
    caught: list[Text] = []
    try:
        with in_python_words(), script_run_once(), _sink(name, quiet) as sink:
            stage = _checked(name, arguments)
            result = stage.run(Progress(sink, caught.append))
    finally:
        for text in caught:
            warnings.warn(text.shown(_in_python), stacklevel=_users_level())
    return stage.entry, {"warnings": caught} | stored(plain(result))


def _checked(name: str, arguments: Mapping[str, Any]) -> Stage:
    try:
        return command_class(name).checked(
            {key: plain(value) if isinstance(value, np.ndarray | np.generic | list | tuple)
             else value for key, value in arguments.items()})
    except InputError as error:
        error.fix = Text(f"limber.settings({name!r}) lists what it takes.")
        raise


def _users_level() -> int:
    """Number of calls between the function that asks and the line that called a verb."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and frame.f_globals["__name__"].startswith("limber."):
        frame, level = frame.f_back, level + 1
    return level


@contextlib.contextmanager
def script_run_once() -> Iterator[None]:
    """Keep the processes that a stage starts from importing the user's script: that would run it
    again, and they do not need it."""
    with _lock:
        _hidden.append(_hidden[0] if _hidden else sys.modules["__main__"])
        sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        with _lock:
            script = _hidden.pop()
            if not _hidden:
                sys.modules["__main__"] = script


@contextlib.contextmanager
def _sink(title: str, quiet: bool) -> Iterator[Sink | None]:
    """The progress display: a bar in a terminal, a line in a notebook, none elsewhere."""
    if quiet:
        yield None
    elif "ipykernel" in sys.modules:
        with LineSink(title) as line:
            yield line
    elif sys.stderr.isatty():
        with BarSink(title) as bar:
            yield bar
    else:
        yield None


@contextlib.contextmanager
def in_python_words() -> Iterator[None]:
    """Make error messages name keyword arguments instead of options."""
    try:
        yield
    except LimberError as error:
        error.seen, error.why, error.fix = (
            Text(text.shown(_in_python)) for text in (error.seen, error.why, error.fix))
        raise


def _in_python(part: Option | Command) -> str:
    if isinstance(part, Command):
        return str(part)
    return part.name if part.value is None else f"{part.name}={part.value!r}"


# Entries of a branch folder by name.

Value = TypeVar("Value")


class ByName(Mapping[str, Value], Generic[Value]):
    """Entries of a branch folder by name; each is read on request."""

    def __init__(self, names: list[str], read: Callable[[str], Value]):
        self._names, self._read = tuple(names), read

    def __getitem__(self, name: str) -> Value:
        if name not in self._names:
            raise KeyError(f"{name!r} does not exist; known: {', '.join(self._names) or 'none'}")
        return self._read(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __repr__(self) -> str:
        return f"<{', '.join(self._names) or 'none'}>"


PathLike = str | os.PathLike[str]


class Branch:
    """A branch folder and its operations.

    Nothing is kept in memory: each verb reads the folder and writes to it, as commands do.

    Args:
        folder: Folder of the branch; :func:`limber.open` takes the same.

    Raises:
        BranchFolderError: there is no such folder, or it is damaged or of a newer format.

    >>> branch = limber.open("a.branch")
    >>> bent = branch.simulate(move=(0.01, 0, 0), kind="static", duration=0.1, hold=0)
    >>> bent.times.shape, bent.converged, bool(bent.energies[-1] > 0)
    ((7,), True, True)
    >>> list(branch.pulls), branch.pulls["pull-1"].forces.shape
    (['pull-1'], (24, 3))
    >>> branch.plan(gaol=(0, 0, 1))
    Traceback (most recent call last):
    ...
    limber.core.errors.InputError: plan has no 'gaol'. Did you mean goal? ...
    """

    def __init__(self, folder: PathLike):
        self.folder = Path(folder)
        self.name: str = self._read().name

    @property
    def mesh(self) -> "TetMesh":
        """The tetrahedra: ``nodes`` [m], ``tets``, ``cell_data["young"]`` [Pa] and more.

        >>> limber.open("a.branch").mesh.tets.shape[1]
        10

        Raises:
            BranchFolderError: there is no mesh yet.
        """
        from limber.store.loading import load_mesh

        return load_mesh(self._read())

    @property
    def skeleton(self) -> "Skeleton":
        """The axes as a tree: ``nodes`` [m], ``parent``, ``radius`` [m], ``order`` and more.

        >>> limber.open("a.branch").skeleton.branch_count
        3

        Raises:
            BranchFolderError: there is no skeleton yet.
        """
        from limber.store.loading import load_skeleton

        return load_skeleton(self._read())

    @property
    def alternatives(self) -> "tuple[Alternative, ...]":
        """The most likely skeletons, the one in use first: ``probability``, ``length`` [m] and
        ``edits``, which make it of the one in use and are in the scan's coordinates.

        ``branch.run("skeleton", alternative=2)`` applies those of the second. There are none of a
        skeleton that was not searched.

        >>> [other.length for other in limber.open("a.branch").alternatives]
        []

        Raises:
            BranchFolderError: the folder is damaged.
        """
        from limber.geometry.skeleton.alternatives import from_entries

        made = self._read().made
        return from_entries(made.result.get("alternatives") or [] if made else [])

    @property
    def pulls(self) -> "Mapping[str, Pull]":
        """The recordings by name.

        >>> limber.open("a.branch").pulls["pull-1"].times[0]
        0.0
        """
        from limber.store.loading import known_pulls

        branch = self._read()
        entries = branch.manifest.stages
        return ByName(known_pulls(branch), lambda name: cast("Pull", result_of(
            branch, f"pull:{name}",
            entries[f"pull:{name}"].result if f"pull:{name}" in entries else {})))

    @property
    def results(self) -> Mapping[str, Result]:
        """The results that the folder holds, such as ``estimate`` or ``plan:path``, by name.

        >>> limber.open("a.branch").results["plan:to-goal"].name
        'to-goal'
        """
        branch = self._read()
        entries = branch.manifest.stages
        return ByName(sorted(entries), lambda key: result_of(branch, key, entries[key].result))

    def plot(self) -> "Figure":
        """Draw the scan and its skeleton from the front and from the side.

        >>> limber.open("a.branch").plot().savefig("scan.png")
        """
        from limber.results.report.figures import scan_and_skeleton

        branch = self._read()
        branch.require("cloud.ply", "reconstruct")
        return drawn(lambda: scan_and_skeleton(branch, []))

    def add_pull(self, source: PathLike, name: str, *, quiet: bool = False,
                 **settings: Any) -> "Pull":
        """Import a recording of a pull into the branch folder.

        Args:
            source: A robot's log, a bag, a table of markers, or a folder of them.
            name: Name of the pull.
            quiet: Show no progress.
            settings: ``unit``, ``cell`` (the robot's cell file), ``grasp_point`` [m], ``weight``
                [N] and those that ``limber.settings("add_pull")`` lists.

        Raises:
            InputError: the recording or a setting cannot be used.

        >>> folder = "a.branch/pulls/pull-1"
        >>> limber.open("a.branch").add_pull(f"{folder}/markers.csv", "mine",
        ...                                  robot=f"{folder}/robot.csv").poses.shape
        (24, 6)
        """
        return cast("Pull", self._run("add_pull", quiet, settings, source=source, name=name))

    def virtual_pull(self, *, quiet: bool = False, **settings: Any) -> "Pull":
        """Simulate a pull of the branch with a known Young's modulus and the noise of sensors.

        Args:
            quiet: Show no progress.
            settings: ``name``, ``young`` [Pa] at the control points, ``frames``, ``reach``,
                ``position_noise`` [m], ``force_noise`` [N], ``seed`` and those that
                ``limber.settings("virtual_pull")`` lists.

        Raises:
            WorkError: the branch cannot be pulled in this way.

        >>> limber.open("a.branch").virtual_pull(name="short", frames=4, seed=1).forces.shape
        (4, 3)
        """
        return cast("Pull", self._run("virtual_pull", quiet, settings))

    def estimate(self, *, quiet: bool = False, **settings: Any) -> "Estimate":
        """Estimate Young's modulus along the branch from its pulls, and enter it in the mesh.

        Args:
            quiet: Show no progress.
            settings: ``pull`` (names; without it all), ``method``, ``fractions`` of the control
                points, ``bag`` (a recording to import first) and those that
                ``limber.settings("estimate")`` lists.

        Raises:
            InputError: there are no pulls, or they cannot determine Young's modulus.
            WorkError: the fit has no result.

        >>> found = limber.open("a.branch").estimate(pull=("pull-1",))  # doctest: +SKIP
        >>> found.young, found.interval                                 # doctest: +SKIP
        """
        if settings.get("follow"):
            raise InputError("follow was given.", "It estimates while a pull is recorded, and "
                             "returns another result.",
                             "Use branch.run(\"estimate\", follow=True).")
        return cast("Estimate", self._run("estimate", quiet, settings))

    def simulate(self, *, quiet: bool = False, **settings: Any) -> "Simulation":
        """Pull the branch by a pose or a force.

        Args:
            quiet: Show no progress.
            settings: ``move`` [m], ``turn`` [rad] or ``grasp_force`` [N], ``kind`` ("static",
                "dynamic"), ``duration`` [s], ``young`` [Pa], ``along`` (a table of poses) or
                ``pull`` (a recording to replay), ``name`` and those that
                ``limber.settings("simulate")`` lists.

        Raises:
            ConvergenceError: the branch could not follow; the part it reached is in
                ``branch.results["simulate"]``.

        >>> branch = limber.open("a.branch")
        >>> bent = branch.simulate(move=(0.005, 0, 0), kind="static", duration=0.1, hold=0)
        >>> bent.forces.shape, bool(bent.strains.max() < 0.02)
        ((7, 3), True)
        """
        return cast("Simulation", self._run("simulate", quiet, settings))

    def load(self, *, quiet: bool = False, **settings: Any) -> "Load":
        """Put the branch under wind, snow, fruit or a cut.

        Args:
            quiet: Show no progress.
            settings: ``wind`` [m/s], shape [3], ``gust``, ``snow`` [kg/m^2], ``fruit`` ((x, y, z,
                kg), ...), ``cut`` ((x, y, z), ...), ``limit_load``, ``name`` (keeps the result in
                the folder) and those that ``limber.settings("load")`` lists.

        Raises:
            WorkError: no equilibrium of the branch was found under the loads.

        >>> calm = limber.open("a.branch").load(wind=(0.1, 0, 0))
        >>> gale = limber.open("a.branch").load(wind=(10, 0, 0))
        >>> bool(gale.greatest_strain > calm.greatest_strain)
        True
        """
        return cast("Load", self._run("load", quiet, settings))

    def energy_field(self, *, quiet: bool = False, **settings: Any) -> "EnergyField":
        """Sample grasp poses and fit the deformation energy over them.

        Args:
            quiet: Show no progress.
            settings: ``samples``, ``field_error`` [%], ``deflection``, ``seed`` and
                those that ``limber.settings("energy_field")`` lists.

        Raises:
            WorkError: too few poses could be solved.

        >>> field = limber.open("a.branch").energy_field(samples=40)  # doctest: +SKIP
        >>> field.energy([[0.02, 0.0, 0.25]])                         # doctest: +SKIP
        """
        return cast("EnergyField", self._run("energy_field", quiet, settings))

    def plan(self, *, quiet: bool = False, **settings: Any) -> "Plan":
        """Plan a gentle path of the grasp on the energy field; the shortest one for comparison.

        Args:
            quiet: Show no progress.
            settings: ``goal`` or ``tip_goal`` [m], ``target``, ``max_force`` [N], ``max_strain``,
                ``max_detour`` [%], ``cell`` (the robot's cell file), ``name`` and those that
                ``limber.settings("plan")`` lists.

        Raises:
            BranchFolderError: there is no energy field, or one of another branch.
            NoPathError: no path reaches the goal; the message states why.

        >>> soft = limber.open("a.branch").plan(max_strain=0.02, name="soft")  # doctest: +SKIP
        >>> soft.strains.max() <= 0.02                                        # doctest: +SKIP
        """
        return cast("Plan", self._run("plan", quiet, settings))

    def execute(self, cell: PathLike, *, quiet: bool = False, **settings: Any) -> "Execution":
        """Check a plan for a robot; with ``arm=True`` and ``confirm=NAME`` follow it.

        Args:
            cell: The robot's cell file.
            quiet: Show no progress.
            settings: ``name`` of the plan, ``speed`` [m/s], ``arm``, ``confirm`` and those that
                ``limber.settings("execute")`` lists.

        Raises:
            InputError: plan, cell and branch do not belong together, or the user did not confirm.
            NoPathError: the arm cannot follow the path.
            SafetyStop: it was stopped; its ``result`` states where.

        >>> limber.open("a.branch").execute("cell.toml", name="to-goal")  # doctest: +SKIP
        """
        return cast("Execution", self._run("execute", quiet, settings, cell=cell))

    def report(self, *, quiet: bool = False, **settings: Any) -> Written:
        """Write one HTML page with figures and tables of all results.

        Args:
            quiet: Show no progress.
            settings: ``picture``, ``caliper`` and those that ``limber.settings("report")`` lists.

        >>> limber.open("a.branch").report().path.name
        'report.html'
        """
        return cast(Written, self._run("report", quiet, settings))

    def scene(self, output: PathLike, *, quiet: bool = False, **settings: Any) -> Written:
        """Write a Blender scene with the branch, its motion and paths.

        Args:
            output: The .blend to write.
            quiet: Show no progress.
            settings: ``render`` (a PNG), ``turntable``, ``color``, ``plan`` and those that
                ``limber.settings("scene")`` lists.

        Raises:
            WorkError: Blender failed, or is not installed.

        >>> limber.open("a.branch").scene("a.blend", render="a.png")  # doctest: +SKIP
        """
        return cast(Written, self._run("scene", quiet, settings, output=output))

    def export(self, output: PathLike, *, quiet: bool = False, **settings: Any) -> Written:
        """Write the branch for another program.

        Args:
            output: The file; its suffix is the format: .xml (MuJoCo), .urdf, .usd, .inp, .mat,
                .csv, .mtg or .swc.
            quiet: Show no progress.
            settings: ``links``, ``columns`` and those that ``limber.settings("export")`` lists.

        Raises:
            InputError: the suffix is not known, or the file cannot be written.

        >>> limber.open("a.branch").export("a.xml").path.name
        'a.xml'
        """
        return cast(Written, self._run("export", quiet, settings, output=output))

    def run(self, stage: str, *, quiet: bool = False, **settings: Any) -> Result:
        """Run a stage without a verb, such as ``predict``, ``swing`` or ``target``.

        Args:
            stage: Name of its command.
            quiet: Show no progress.
            settings: Its inputs, settings and options, as ``limber.settings(stage)`` lists them.

        Raises:
            InputError: there is no such stage, or a setting is refused.

        >>> limber.open("a.branch").run("predict", weight=0.1).values["drop_m"] > 0
        True
        """
        if known_stage(stage) in ("generate", "reconstruct", "mesh"):
            raise InputError(f"{stage} makes a new branch.", "", f"Call limber.{stage}.")
        return self._run(stage, quiet, settings)

    def session(self, *, mode: str = "rigid", **settings: Any) -> "InteractiveSession":
        """Start a process in which the branch follows its grasps, many times a second.

        Args:
            mode: Mode of the marked grasp: ``rigid`` (the pose is held) or ``point`` (the
            position).
            settings: Fields of :class:`limber.session.protocol.SessionSettings`.

        Returns:
            The session; use it in a ``with`` statement.

        Raises:
            InputError: a setting is refused. WorkError: the session did not start.

        >>> with limber.open("a.branch").session(mode="point") as session:  # doctest: +SKIP
        ...     session.wait(session.move([0.02, 0, 0.25, 0, 0, 0])).energy
        """
        from limber.session.client import InteractiveSession
        from limber.session.protocol import SessionSettings

        known = list(SessionSettings.model_fields)
        for name in settings:
            if name not in known:
                raise InputError(f"session has no {name!r}.", nearest(name, known))
        with in_python_words():
            checked_settings(SessionSettings, {"mode": mode, **settings})
        return InteractiveSession(self.folder, mode=mode, **settings)

    def __repr__(self) -> str:
        parts = "".join(f", {label}: {text}" for label, text in self._shown().items())
        return f"Branch({str(self.folder)!r}{parts})"

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><td>{label}</td><td>{html.escape(text)}</td></tr>"
                       for label, text in self._shown().items())
        return f"<table><caption>{html.escape(self.name)}</caption>{rows}</table>"

    def _shown(self) -> dict[str, str]:
        branch = self._read()
        made = next((branch.manifest.stages[key].result for key in ("reconstruct", "mesh")
                     if key in branch.manifest.stages), {})
        size = {"tetrahedra": f"{made['tet_count']:,}"} if "tet_count" in made else {}
        return size | {"results": ", ".join(sorted(branch.manifest.stages)) or "none"}

    def _read(self) -> Folder:
        return Folder.read(self.folder)

    def _run(self, verb: str, quiet: bool, settings: dict[str, Any], **needed: Any) -> Result:
        name = stage_of(verb)
        key, values = run_stage(name, {**settings, **needed, "branch_folder": self.folder},
                                quiet=quiet)
        if replayed := settings.get("pull") if name == "simulate" else None:
            key = f"replay:{replayed}"
        if settings.get("follow") or not key:
            return (command_class(name).about.result or Result).read(None, name, values)
        return result_of(self._read(), key, values)


# The settings of a verb: their defaults and meanings.

def settings(verb: str) -> "SettingsTable":
    """Return the settings of a verb, or of a command, with their defaults and meanings.

    Raises:
        InputError: there is no such verb.

    >>> limber.settings("plan")["max_force"]
    Setting(meaning='Largest force of the gripper at any pose [N].', default=None)
    """
    from limber.cli.known import command_class

    stage = command_class(known_stage(verb))
    return SettingsTable(verb, {
        name: Setting(field.description or "",
                      "required" if field.is_required() else field.default)
        for name in stage.names() if name != "branch_folder"
        for field in [stage.model_fields[name]]})


@dataclass(frozen=True)
class Setting:
    """A setting of a verb.

    Attributes:
        meaning: With its unit in square brackets.
        default: Or ``required``.
    """

    meaning: str
    default: Any


class SettingsTable(Mapping[str, Setting]):
    """The settings of a verb by name; it prints as a list, and as a table in a notebook."""

    def __init__(self, verb: str, content: Mapping[str, Setting]):
        self._verb, self._content = verb, MappingProxyType({**content})

    def __getitem__(self, name: str) -> Setting:
        return self._content[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._content)

    def __len__(self) -> int:
        return len(self._content)

    def __repr__(self) -> str:
        return "\n".join([f"Settings of {self._verb}:", *(
            f"  {name} = {one.default!r}: {one.meaning}" for name, one in self.items())])

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><td><code>{name}</code></td><td>{html.escape(repr(one.default))}</td>"
                       f"<td>{html.escape(one.meaning)}</td></tr>" for name, one in self.items())
        return (f"<table><caption>{html.escape(self._verb)}</caption>"
                f"<tr><th>setting</th><th>default</th><th>meaning</th></tr>{rows}</table>")


def known_stage(verb: str) -> str:
    """Return the name of a verb's command.

    Raises:
        InputError: there is none.
    """
    from limber.cli.known import command_names

    name, known = stage_of(verb), command_names()
    if name not in known:
        raise InputError(f"There is no stage {verb!r}.", nearest(name, known))
    return name


# The verbs of the Python interface: a branch and its operations.

def generate(folder: PathLike, *, quiet: bool = False, **settings: Any) -> "Generated":
    """Make a branch with known truth, and scan it as a scanner would.

    Args:
        folder: Folder for the scan and its truth.
        quiet: Show no progress.
        settings: ``length`` [m], ``fork_count``, ``noise`` [m], ``seed`` and those that
            ``limber.settings("generate")`` lists.

    >>> scan = limber.generate("scan", length=0.3, fork_count=0, seed=1)
    >>> scan.cloud.name, scan.young.shape
    ('cloud.ply', (4,))
    """
    from limber.stages.shape.generate import Generated

    _, values = run_stage("generate", {**settings, "folder": folder}, quiet=quiet)
    return Generated.read(None, "generate", values)


def reconstruct(cloud: "PathLike | np.ndarray | Mapping[str, Any]", folder: PathLike, *,
                quiet: bool = False, **settings: Any) -> "Branch":
    """Make a branch folder from a scan: skeleton, surface and tetrahedra.

    Args:
        cloud: A point cloud's file; or points, shape [n, 3]; or columns ``x``, ``y``, ``z`` and
            others by name, as a structured array or a table of pandas has them. Numbers are in
            ``unit``.
        folder: The branch folder to make or replace.
        quiet: Show no progress.
        settings: ``unit`` ("m", "cm", "mm", "in", "um"), ``root`` [3], ``mesh_spacing`` in radii,
            ``young`` [Pa], ``skeleton`` (a file of your own) and those that
            ``limber.settings("reconstruct")`` lists.

    Raises:
        InputError: the scan or a setting cannot be used. WorkError: no branch was found.

    >>> branch = limber.reconstruct("scan/cloud.ply", "new.branch", mesh_spacing=4)
    >>> branch.mesh.cell_data["young"].max() / 1e6
    100.0
    """
    if isinstance(cloud, str | os.PathLike):
        if Path(cloud).is_dir():
            raise InputError(f"{cloud} is a folder.", "One scan becomes one branch.",
                             "Call limber.reconstruct for each of its files.")
        return _made("reconstruct", folder, quiet, {**settings, "cloud": cloud})
    with tempfile.TemporaryDirectory(prefix="limber-cloud-") as temporary:
        path = Path(temporary) / "array.ply"
        _write_cloud(cloud, path)
        return _made("reconstruct", folder, quiet, {**settings, "cloud": path})


def mesh(surface: PathLike, folder: PathLike, *, quiet: bool = False, **settings: Any) -> "Branch":
    """Make a branch folder from a closed surface, a table of sections or a cylinder model.

    Args:
        surface: The file: STL, PLY, OBJ, a CSV of sections, or a cylinder model.
        folder: The branch folder to make or replace.
        quiet: Show no progress.
        settings: ``unit``, ``root`` [3], ``young`` [Pa] and those that
            ``limber.settings("mesh")`` lists.

    Raises:
        InputError: the surface or a setting cannot be used. MeshingError: meshing failed.

    >>> sections = ["x_mm,y_mm,z_mm,width_mm,height_mm", "0,0,0,10,10", "0,0,200,10,10"]
    >>> _ = Path("beam.csv").write_text("\\n".join(sections))
    >>> limber.mesh("beam.csv", "beam.branch").mesh.nodes[:, 2].max().round(3)
    0.2
    """
    return _made("mesh", folder, quiet, {**settings, "surface": surface})


def open(folder: PathLike) -> "Branch":
    """Return the branch of a folder that :func:`limber.reconstruct` or a command has made.

    Raises:
        BranchFolderError: there is no such folder, or it is damaged or of a newer format.

    >>> limber.open("a.branch").mesh.is_quadratic
    True
    """
    return Branch(folder)


def run(command: str, *, quiet: bool = False, **settings: Any) -> Result:
    """Run a command that has no verb, such as ``robot draw``, ``robot check`` or ``doctor``.

    Args:
        command: Its name.
        quiet: Show no progress.
        settings: Its inputs, settings and options, as ``limber.settings(command)`` lists them.

    Raises:
        InputError: there is no such command, or a setting is refused.

    >>> limber.run("verify", branch_folder="a.branch").values["file_count"] > 5
    True
    """
    return Result.read(None, command, run_stage(known_stage(command), settings, quiet=quiet)[1])


def _made(stage: str, folder: PathLike, quiet: bool, arguments: dict[str, Any]) -> Branch:
    run_stage(stage, {**arguments, "output": folder}, quiet=quiet)
    return Branch(folder)


def _write_cloud(cloud: "np.ndarray | Mapping[str, Any]", path: Path) -> None:
    """Write points or columns as a PLY file.

    Raises:
        InputError: they are not points.
    """
    from limber.geometry.cloud.cloud import Cloud

    names = getattr(getattr(cloud, "dtype", None), "names", None) or (
        list(cloud) if hasattr(cloud, "keys") else None)
    if names is None:
        points = np.asarray(cloud)
        if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
            raise InputError(f"The cloud is an array of shape {points.shape} and type "
                             f"{points.dtype}.",
                             "Points have shape [n, 3].",
                             "Give other columns by name: {\"x\": ..., \"red\": ...}.")
        columns = dict(zip("xyz", points.T, strict=True))
    else:
        columns = {str(name): np.asarray(cloud[name]) for name in names}
    Cloud.from_columns(columns).write_ply(path)
