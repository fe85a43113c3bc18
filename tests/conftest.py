"""What every test shares: real recordings; small meshes, branches and pulls with known truth."""

import gc
import json
import os
import shutil
import signal
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.subjects.meshes import box_mesh

from benchmarks.paper_branches import Bench, PaperBranch, exact_pull
from limber.estimation.simulated_pull import TrueBranch
from limber.geometry.tets.tet_mesh import TetMesh
from limber.recordings.recording import GraspEntry, Observations, Pull, PullEntry, SensorEntry

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Started in the background of a shell, or under one that ignores Ctrl-C: the programs that
    # tests start would inherit that, and no user's does.
    signal.signal(signal.SIGINT, signal.default_int_handler)

MEMORY = Path("/dev/shm")
if ("TMPDIR" not in os.environ and MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > 4e9
        and not os.statvfs(MEMORY).f_flag & os.ST_NOEXEC):
    # Stages flush each file to the disk; in memory that takes no time.
    os.environ["TMPDIR"] = tempfile.tempdir = str(MEMORY)

# Other tests run beside each one and have the other cores: no stage starts processes for them. What
# is about processes asks for its own number.
os.environ.setdefault("LIMBER_CORES", "1")


@pytest.fixture(scope="session")
def recorded_data() -> Path:
    """The folder of real recordings and reference tables; its README names their sources."""
    return Path(__file__).parent / "data"


@pytest.fixture(scope="session")
def short_box() -> TetMesh:
    """A block of 72 quadratic tetrahedra, fixed at z = 0."""
    return box_mesh()


@pytest.fixture(scope="session")
def slender_beam() -> TetMesh:
    """A square beam 0.6 m long and 8 mm thick, 1,488 quadratic tetrahedra."""
    return box_mesh((0.008, 0.008, 0.6), (1, 1, 248))


class _SmallBranch(PaperBranch):
    """True on a finer mesh than fits use, of the same six sides: so coarse, sides would show."""

    def truth(self) -> TrueBranch:
        fine = self.mesh(slice_length=1.6, sides=6)
        return replace(super().truth(), mesh=fine)


@pytest.fixture(scope="session")
def small() -> PaperBranch:
    """Short and thick: few tetrahedra; E falls by a factor of 13 along it."""
    return _SmallBranch("small", (40e6, 22e6, 12e6, 3e6), 0.36, 0.40, (0.010, 0.008), 0.4)


@pytest.fixture(scope="session")
def small_pull(small) -> Pull:
    """16 frames, without noise."""
    return exact_pull(small, 0, frames=16)


@pytest.fixture(scope="session")
def small_bench(small) -> Bench:
    return Bench(small, slice_length=2.4, sides=6)


@pytest.fixture
def plain_pull() -> Pull:
    """A recording made by hand: a spring of 50 N/m pulled out 0.1 m, two markers that follow."""
    times = np.linspace(0.0, 4.0, 201)
    eased = np.clip((times - 0.4) / 3.0, 0.0, 1.0)
    way = 0.1 * eased**2 * (3 - 2 * eased)
    poses = np.zeros((201, 6))
    poses[:, 0], poses[:, 2] = way, 0.5
    rng = np.random.default_rng(0)
    wrenches = np.zeros((201, 6))
    wrenches[:, 0] = 50.0 * way
    wrenches[:, :3] += 0.02 * rng.standard_normal((201, 3))
    seen = np.linspace(0.2, 3.8, 60)
    moved = np.interp(seen, times, way)
    positions = np.zeros((60, 2, 3))
    positions[:, 0, 0], positions[:, 0, 2] = 0.3 * moved, 0.2
    positions[:, 1, 0], positions[:, 1, 2] = 0.7 * moved, 0.35
    entry = PullEntry(grasp=GraspEntry(point_m=(0.0, 0.0, 0.5), radius_m=0.01),
                      sensor=SensorEntry(force_sigma_n=0.02))
    return Pull("spring", entry, times, poses, wrenches, Observations(seen, positions))


@pytest.fixture(scope="session")
def branch_template(tmp_path_factory, small, small_bench):
    """A branch folder as reconstruct leaves it, with one virtual pull of 12 frames."""
    from tests.stages.specified import SpecifiedPull

    from limber.estimation.settings import PullSpec
    from limber.store import Branch

    folder = tmp_path_factory.mktemp("branches") / "small.branch"
    branch = Branch.create(folder)
    with branch.stage("reconstruct") as stage:
        small.skeleton.write_swc(stage.path("skeleton.swc"))
        count = small_bench.mesh.tet_count
        small_bench.mesh.with_data(cell_data={
            "young": np.full(count, 1e8), "poisson": np.full(count, 0.36),
            "density": np.full(count, 900.0)}).write(stage.path("mesh.vtu"))
    settings = PullSpec(young=small.young, poisson=0.36, frames=12, seed=4, phase=0.5)
    SpecifiedPull.of(settings, branch_folder=folder, name="pull-1").run()
    return folder


@pytest.fixture
def unpainted(monkeypatch):
    """Figures of a report are drawn, but no pixels are made of them, which takes five seconds."""
    from matplotlib import pyplot

    monkeypatch.setattr("limber.results.report.section._png",
                        lambda figure: pyplot.close(figure) or b"\x89PNG")


@pytest.fixture
def branch_folder(branch_template, tmp_path):
    """A copy to work in: a branch folder can be moved and copied."""
    return shutil.copytree(branch_template, tmp_path / "small.branch")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as slow what the last whole run took over half a second for; refuse a test held to wall
    clocks where `scripts/test` does not look for it."""
    lost = [item.nodeid for item in items if item.get_closest_marker("real_time") is not None
            and Path(__file__).parent / "robot" not in item.path.parents]
    if lost:
        raise pytest.UsageError(f"real_time is for tests/robot alone: {', '.join(lost)}")
    known = json.loads((Path(__file__).parent / "durations.json").read_text(encoding="utf-8"))
    for item in items:
        path, _, name = item.nodeid.partition("::")
        if f"{path.removesuffix('.py').replace('/', '.')}::{name}" in known:
            item.add_marker("slow")
        # tests/run.py asks for a mark of every new test that takes long.
        if LONG & {mark.name for mark in item.iter_markers()}:
            item.user_properties.append(("long", "yes"))


def pytest_collection_finish() -> None:
    """Spare the garbage collector what all tests have loaded: each of its walks took 0.3 s."""
    gc.collect()
    gc.freeze()


def pytest_unconfigure() -> None:
    """At the end nothing is left."""
    gc.unfreeze()


LONG = {"slow", "campaign", "real_time", "real_blender"}
"""Marks that a test which takes long has one of."""
