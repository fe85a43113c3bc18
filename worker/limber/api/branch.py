"""A branch folder and its operations, as a Python object."""

import html
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from limber.api.by_name import ByName
from limber.api.running import in_python_words, run_stage, stage_of
from limber.api.settings_table import known_stage
from limber.cli.known import command_class
from limber.core.errors import InputError
from limber.core.settings import checked_settings, nearest
from limber.stages.registry import result_of
from limber.stages.result import Result, Written, drawn
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
            mode: Mode of the marked grasp: ``clamped`` (the pose is held) or ``pinned`` (the
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
