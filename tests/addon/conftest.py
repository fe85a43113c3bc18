"""What tests of the add-on share: branch folders with known motion, bpy, the add-on, a Blender."""

import contextlib
import csv
import importlib
import importlib.util
import io
import json
import os
import shutil
import struct
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import limber
from limber.cli.main import call
from limber.geometry.tets.tet_mesh import TetMesh
from limber.geometry.tets.tree_sweep import straight_beam
from limber.store import Branch

ROOT = Path(__file__).parents[2]
ADDON = ROOT / "addon"
PATH_COLUMNS = ("s_m", "x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad", "energy_j", "force_n",
                "strain")


def part(name: str):
    """Return a module of the add-on."""
    return importlib.import_module(f"limber_addon.{name}")


@dataclass(frozen=True)
class BeamBranch:
    """A branch folder of a beam that bends by a formula: every frame is known."""

    folder: Path
    mesh: TetMesh
    surface: np.ndarray
    frames: np.ndarray
    path: np.ndarray


def _write_pc2(path: Path, frames: np.ndarray) -> None:
    """Write frames [f, v, 3] m as PC2, independently of the code under test."""
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, frames.shape[1], 0.0, 1.0, len(frames))
    path.write_bytes(head + np.ascontiguousarray(frames, "<f4").tobytes())


def bent(points: np.ndarray, amount: float) -> np.ndarray:
    """Return ``points`` [n, 3] bent towards x by ``amount`` times the square of the height."""
    moved = np.array(points, float)
    moved[:, 0] += amount * points[:, 2] ** 2
    return moved


def make_beam_branch(folder: Path, frame_count: int = 6, *, plan: bool = True) -> BeamBranch:
    """Write a branch folder with a mesh, a plan, its baseline and frames."""
    mesh = straight_beam(0.6, 0.012, 0.005, slice_count=12, grasp_fraction=0.67)
    height = mesh.centroids[:, 2] / 0.6
    mesh = mesh.with_data(cell_data={"young": 2.5e7 * np.exp(-2.5 * height)})
    surface = mesh.nodes[np.unique(mesh.surface_faces())]
    amounts = np.linspace(0.0, 1.0, frame_count)
    frames = np.array([bent(surface, amount) for amount in amounts])
    grasp = mesh.nodes[mesh.point_data["grasp"] > 0].mean(axis=0)
    path = np.vstack([bent(grasp[None], amount) for amount in amounts])
    branch = Branch.create(folder)
    with branch.stage("reconstruct") as stage:
        mesh.write(stage.path("mesh.vtu"))
        stage.result["length_m"] = 0.6
    if plan:
        with branch.stage("plan:to-goal", reads=["mesh.vtu"]) as stage:
            write_plan(stage, path)
            _write_pc2(stage.path("frames/to-goal.pc2"), frames)
            stage.path("frames/to-goal.json").write_text(json.dumps(
                {"frame_count": frame_count, "energies_j": list(0.01 * amounts)}))
            # Not physics, but known: grows with the frame, and from the tip to the base.
            density = 1000.0 * amounts[:, None] * (0.61 - surface[:, 2])
            np.savez(stage.path("frames/to-goal.npz"), strain_energy_density_j_m3=density)
    return BeamBranch(folder, mesh, surface, frames, path)


def write_plan(stage, path: np.ndarray) -> None:
    for name, points in (("to-goal", path), ("to-goal-baseline", path + [[0.0, 0.01, 0.0]])):
        with open(stage.path(f"plans/{name}.csv"), "w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(PATH_COLUMNS)
            writer.writerows([0.0, *point, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0] for point in points)
    stage.path("plans/to-goal-trees.csv").write_text("planner,x_m,y_m,z_m,parent\n" + "".join(
        f"D-RRT*,{x:.9g},{y:.9g},{z:.9g},{number - 1}\n" for number, (x, y, z) in enumerate(path)))
    stage.path("plans/to-goal.json").write_text(json.dumps({
        "goal": {"kind": "grasp", "position_m": list(path[-1]), "tolerance_m": 0.02},
        "plan": {"length_m": 0.13, "energy_sum_nmm": 4.5},
        "baseline": {"length_m": 0.11, "energy_sum_nmm": 6.5},
        "energy_saved_percent": 31.0, "length_added_percent": 18.0}))


@pytest.fixture(scope="session")
def write_pc2():
    """A function that writes frames [f, v, 3] m as PC2, independently of the code under test."""
    return _write_pc2


@pytest.fixture()
def beam(tmp_path: Path) -> BeamBranch:
    """A fresh branch folder of a bending beam."""
    return make_beam_branch(tmp_path / "beam.branch")


@pytest.fixture()
def bare_beam(tmp_path: Path) -> BeamBranch:
    """A branch folder as it is after reconstruction: no plan, no frames."""
    return make_beam_branch(tmp_path / "bare.branch", plan=False)


@pytest.fixture()
def bpy():
    """The bpy module with an empty file."""
    module = pytest.importorskip("bpy", reason="NO BPY: scripts/setup --with-blender")
    module.ops.wm.read_factory_settings(use_empty=True)
    return module


@pytest.fixture()
def addon(bpy):
    """The add-on as a package called ``limber_addon``, not registered."""
    if "limber_addon" not in sys.modules:
        spec = importlib.util.spec_from_file_location(
            "limber_addon", ADDON / "__init__.py", submodule_search_locations=[str(ADDON)])
        sys.modules["limber_addon"] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules["limber_addon"])
    return sys.modules["limber_addon"]


@pytest.fixture(scope="session")
def worker_python(tmp_path_factory) -> str:
    """A Python that runs the very limber that is tested, whichever is installed in this one.

    The add-on hands no PYTHONPATH on.
    """
    tested = Path(limber.__file__).parents[1]
    code = "import limber; print(limber.__file__)"
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    found = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True,
                           text=True, env=clean, cwd="/")
    if found.stdout.strip() == limber.__file__ or os.name != "posix":
        return sys.executable
    script = tmp_path_factory.mktemp("python") / "python"
    script.write_text(f"#!/bin/sh\nPYTHONPATH={tested} exec {sys.executable} \"$@\"\n")
    script.chmod(0o755)
    return str(script)


@pytest.fixture()
def registered(addon, monkeypatch, worker_python):
    """The add-on, registered, with this Python as the worker's."""
    monkeypatch.setenv("LIMBER_PYTHON", worker_python)
    addon.register()
    yield addon
    addon.unregister()


@pytest.fixture()
def whole_texts(registered, monkeypatch):
    """Panels draw each text as one line, however wide: for tests of what they say.

    Every module is loaded before: one that took the replaced function would keep it.
    """
    lines = part("panels.lines")
    monkeypatch.setattr(lines, "wrapped", lambda text, _space: (text,) if text else ())


class Ended:
    """A worker's process that has ended, as a job sees one, and what it said."""

    def __init__(self, code: int = 0, *told: dict | str):
        self.poll, self.stdin = lambda: code, io.StringIO()
        self._told = list(told or [{"status": "done", "seconds": 0.0}])

    def told(self) -> list[dict | str]:
        return [self._told.pop(0) for _ in list(self._told)]


@pytest.fixture()
def worker_here(registered, monkeypatch):
    """The worker's commands run in this process, which has loaded what they need.

    For tests of what is asked of the worker and what is done with its answer. Those of operators
    and jobs start it as the process that it is.
    """
    jobs = part("jobs.jobs")
    launch = jobs.Job.launch

    def launch_here(job) -> None:
        if job.command[1:3] != ["-m", "limber"]:
            return launch(job)
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            code = call(job.command[3:])
        object_in = part("jobs.worker_process")._object_in
        job._process = Ended(code, *(object_in(line) or line
                                     for line in said.getvalue().splitlines()))
        job.state = jobs.JobState.RUNNING
        return None
    monkeypatch.setattr(jobs.Job, "launch", launch_here)


@pytest.fixture(scope="session")
def blender() -> str:
    """The real Blender's program."""
    path = os.environ.get("LIMBER_BLENDER") or shutil.which("blender")
    if not path:
        pytest.skip("NO REAL BLENDER: set LIMBER_BLENDER=$(scripts/provision_blender | tail -1)")
    return path


@pytest.fixture(scope="session")
def extension_zip(tmp_path_factory) -> Path:
    """The extension, built as a user would; or that of LIMBER_TEST_ZIP, as one with wheels is."""
    if given := os.environ.get("LIMBER_TEST_ZIP"):
        return Path(given)
    out = tmp_path_factory.mktemp("build")
    done = subprocess.run([ROOT / "scripts" / "build_extension", "--output-dir", out], check=False,
                          capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "valid according to" in done.stderr
    return Path(done.stdout.splitlines()[-1])


@pytest.fixture(scope="session")
def has_worker(extension_zip) -> bool:
    """Whether the zip brings the worker along, as wheels."""
    with zipfile.ZipFile(extension_zip) as content:
        return any(name.endswith(".whl") for name in content.namelist())


@pytest.fixture(scope="session")
def environment(tmp_path_factory, worker_python, has_worker) -> dict[str, str]:
    """An environment whose Blender keeps its settings in a folder of the test, with our worker or
    with none but the zip's own."""
    resources = {"BLENDER_USER_RESOURCES": str(tmp_path_factory.mktemp("resources"))}
    if not has_worker:
        return os.environ | resources | {"LIMBER_PYTHON": worker_python}
    return {name: value for name, value in os.environ.items()
            if name not in ("LIMBER_PYTHON", "PYTHONPATH")} | resources | {
                "PATH": "/usr/sbin:/usr/bin:/sbin:/bin"}


@pytest.fixture(scope="session")
def run(blender, environment, extension_zip):
    """A function that runs Blender with the extension installed and enabled."""
    def run(*arguments, timeout=120, **extra):
        return subprocess.run([blender, *map(str, arguments)], check=False, capture_output=True,
                              text=True, timeout=timeout, env=environment | extra)
    installed = run("-b", "--command", "extension", "install-file", "-r", "user_default",
                    "--enable", extension_zip)
    assert installed.returncode == 0, installed.stdout + installed.stderr
    # Not Blender's message: it is lost where the installer ends between a read and a poll.
    folder = Path(environment["BLENDER_USER_RESOURCES"]) / "extensions" / "user_default" / "limber"
    assert (folder / "blender_manifest.toml").is_file(), installed.stdout + installed.stderr
    return run
