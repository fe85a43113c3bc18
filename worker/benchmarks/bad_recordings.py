"""Bad recordings, each through a user's commands: exit code 2 or 3, and the reason.

A branch of one modulus is hung with a weight and filmed; possible faults of such a recording are
introduced, one at a time.
"""

import contextlib
import io
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.paper_branches import PaperBranch
from benchmarks.table import Asked, Row, Setting
from limber.cli.main import call
from limber.geometry.tets.tet_mesh import mark
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.statics.solve import solve_static
from limber.recordings.recorded_grasp import grasp_on
from limber.recordings.recording import GraspEntry
from limber.recordings.time_series import Stream, write_stream
from limber.store import Branch

YOUNG, WEIGHT = 2.5e7, 0.4
GRAVITY = (0.0, 0.0, -9.80665)
LABELS = ("tip1", "tip2", "tip3", "base1", "base2")
PLACES = ((80, (0.0, 0.012, 0.0)), (70, (0.0, -0.014, 0.0)), (60, (0.012, 0.0, 0.01)),
          (4, (0.015, 0.0, 0.0)), (8, (0.0, 0.02, 0.0)))
"""Positions of the markers: the node of the axis, and the offset from it [m]."""


@dataclass(frozen=True)
class Rig:
    """A branch folder, and a camera's recording of the branch under its weight.

    Attributes:
        folder: Folder of all files.
        nominal: Positions of the markers on the branch [m], shape [5, 3].
        grasp: Position of the hung weight [m].
        times: [s], shape [n].
        seen: Markers in the camera's frame [m], shape [n, 5, 3].
    """

    folder: Path
    nominal: np.ndarray
    grasp: np.ndarray
    times: np.ndarray
    seen: np.ndarray

    @property
    def branch(self) -> Path:
        return self.folder / "hung.branch"


def refused_row(setting: Setting) -> list[Row]:
    """Every bad recording, as many as there is time for, and a good one that must pass."""
    with tempfile.TemporaryDirectory() as folder:
        rig = made_rig(Path(folder), setting.generator(31))
        good, _ = _imported(rig)
        wrong, count = [] if good == 0 else [f"a good one: exit {good}"], 1
        for name, (word, run) in setting.budget.items(_CASES.items()):
            setting.progress(count / len(_CASES), name)
            count += 1
            code, told = run(rig)
            if code not in (2, 3) or word not in told:
                wrong.append(f"{name}: exit {code}, {told[:60]!r}")
    # A case that was not run is not known to be refused.
    is_met = False if wrong else True if count == len(_CASES) + 1 else None
    return [Row(*ROW, f"{count - len(wrong)} of {count} as asked"
                + "".join(f"; {each}" for each in wrong), is_met, count)]


def made_rig(folder: Path, rng: np.random.Generator) -> Rig:
    """Make the branch folder, hang the weight, film it."""
    shape = PaperBranch("rig", 4 * (YOUNG,), 0.36, 0.40, (0.010, 0.008), 0.4)
    skeleton, mesh = shape.skeleton, shape.mesh(slice_length=2.0, sides=8)
    branch = Branch.create(folder / "hung.branch")
    with branch.stage("reconstruct") as stage:
        mark(mesh, skeleton, young=2e7, poisson=0.36, density=900.0).write(
            stage.path("mesh.vtu"))
        skeleton.write_swc(stage.path("skeleton.swc"))
    nominal = np.array([skeleton.nodes[node] + beside for node, beside in PLACES])
    grasp = skeleton.nodes[78]
    model = BranchModel(mesh, young=YOUNG, poisson=0.36, density=900.0, gravity=GRAVITY)
    state = solve_static(
        model, grasp=grasp_on(mesh, GraspEntry(point_m=tuple(grasp), radius_m=0.01, mode="point")),
        grasp_force=(0.0, 0.0, -WEIGHT)).require()
    moved = (point_operator(mesh, nominal) @ state.displacement.ravel()).reshape(-1, 3)
    times = np.arange(450) / 100.0
    since = np.maximum(times - 0.3, 0.0)
    part = np.where(times > 0.3, 1 - np.exp(-3 * since) * np.cos(15 * since), 0.0)
    turn = Rotation.from_rotvec(rng.uniform(-2, 2, 3)).as_matrix()
    seen = (nominal + part[:, None, None] * moved) @ turn.T + rng.uniform(-1, 1, 3)
    return Rig(folder, nominal, grasp, times, seen + 2e-5 * rng.standard_normal(seen.shape))


def _imported(rig: Rig, *, labels: tuple[str, ...] = LABELS, weight: float = WEIGHT,
              own_weight: bool = True, **changes: np.ndarray) -> tuple[int, str]:
    """Write a recording and import it as a user does; return the exit code and all output.

    ``changes`` replace attributes of the rig.
    """
    rig = replace(rig, **changes)
    _write_markers(rig, rig.folder / "swing.csv", rig.times, rig.seen, labels)
    return _called("import-pull", rig.branch, rig.folder / "swing.csv", "--name", "hung",
                   "--weight", weight, *(["--own-weight"] if own_weight else []), "--nominal",
                   rig.folder / "nominal.csv", "--grasp-point",
                   *(f"{value:.6f}" for value in rig.grasp), "--force")


def _write_markers(rig: Rig, path: Path, times: np.ndarray, seen: np.ndarray,
                   labels: tuple[str, ...] = LABELS) -> None:
    write_stream(path, Stream(times, seen.reshape(len(seen), -1), tuple(
        f"{label}_{axis}_m" for label in labels for axis in "xyz")))
    rows = [f"{label},{x:.6f},{y:.6f},{z:.6f}"
            for label, (x, y, z) in zip(LABELS, rig.nominal, strict=True)]
    (rig.folder / "nominal.csv").write_text("\n".join(["label,x_m,y_m,z_m", *rows]) + "\n",
                                            encoding="utf-8")


def _called(*words: object) -> tuple[int, str]:
    """Call ``limber`` with these words."""
    told = io.StringIO()
    with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
        code = call([*map(str, words), "--json", "--progress", "none"])
    return code, told.getvalue()


def _collinear(rig: Rig) -> tuple[int, str]:
    along = np.linspace(0.0, 1.0, 5)[:, None] * [0.0, 0.0, 0.35]
    return _imported(rig, seen=rig.seen - rig.seen[:20].mean(axis=0) + along, nominal=along)


def _not_identified(rig: Rig) -> tuple[int, str]:
    """Slow, driven by its path, without force: soft and stiff look alike."""
    still = np.zeros((len(rig.times), 6))
    still[:, :3] = rig.grasp + np.linspace(0, 1, len(rig.times))[:, None] * [0.05, 0.0, 0.0]
    write_stream(rig.folder / "robot.csv", Stream(rig.times, still, (
        "x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")))
    seen = rig.nominal + np.linspace(0, 1, len(rig.times))[:, None, None] * (
        rig.nominal[:, 2:] / rig.grasp[2])**2 * [0.05, 0.0, 0.0]
    _write_markers(rig, rig.folder / "slow.csv", rig.times, seen)
    code, told = _called("import-pull", rig.branch, rig.folder / "slow.csv", "--name", "slow",
                         "--robot", rig.folder / "robot.csv", "--nominal",
                         rig.folder / "nominal.csv", "--time-offset", 0, "--force")
    return (code, told) if code else _called("estimate", rig.branch, "--pull", "slow", "--force")


def _in_another_unit(rig: Rig) -> tuple[int, str]:
    """A weight in the wrong unit: no modulus is as large as it requires."""
    code, told = _imported(rig, weight=4e6, own_weight=False)
    if code:
        return code, told
    code, told = _called("estimate", rig.branch, "--pull", "hung", "--fractions", 0.5, "--force")
    last = next(line for line in reversed(told.splitlines()) if line.startswith("{"))
    return code, "converged, it says" if "converged" in json.loads(last) else told


_CASES: dict[str, tuple[str, Callable[[Rig], tuple[int, str]]]] = {
    "mirrored markers": ("mirrored", lambda rig: _imported(rig, seen=rig.seen * [1, 1, -1])),
    "swapped markers": ("tip1 and tip2", lambda rig: _imported(
        rig, seen=rig.seen[:, [1, 0, 2, 3, 4]])),
    "markers on a line": ("on a line", _collinear),
    "a marker missing": ("base2", lambda rig: _imported(
        rig, seen=rig.seen[:, :4], labels=LABELS[:4])),
    "an unknown label": ("base2", lambda rig: _imported(rig, labels=(*LABELS[:4], "hat"))),
    "a grasp point off the branch": ("from the branch", lambda rig: _imported(
        rig, grasp=rig.grasp + [0.0, 0.2, 0.0])),
    "a swing that has not ended": ("at rest", lambda rig: _imported(
        rig, seen=rig.seen[:70], times=rig.times[:70])),
    "no load shows": ("no visible effect", lambda rig: _imported(
        rig, seen=rig.seen[:30], times=rig.times[:30])),
    "nothing that gives the scale": ("soft or stiff", _not_identified),
    "a load in another unit": ("it is in N", _in_another_unit)}
"""The fault; words in the message, and what makes it."""
ROW = Asked("bad recordings: " + ", ".join(_CASES), "exit 2 or 3 with the reason")
