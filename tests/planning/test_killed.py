"""A killed command leaves no process, and its folder to the next run."""

import io
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from limber.cli.main import call
from limber.core.files.atomic import is_owned_name
from limber.store import Branch

ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.skipif(os.name == "nt", reason="POSIX signals"), pytest.mark.timeout(400)]


@pytest.fixture
def folder(planned_branch, tmp_path) -> Path:
    shutil.copytree(planned_branch, tmp_path / "small.branch")
    return tmp_path / "small.branch"


def command(stage: str, *arguments: object) -> list[str]:
    return [sys.executable, "-m", "limber", stage, *map(str, arguments), "--json", "--progress",
            "json"]


def run(stage: str, *arguments: object) -> None:
    """Run a command in this process, which has its kernels loaded."""
    assert call([stage, *map(str, arguments)]) == 0


def killed_at_work(program: list[str], kind: signal.Signals) -> int:
    """Start a program, kill it once two processes of its pool compute; returns its exit code.

    None of the processes that it had is left.
    """
    process = subprocess.Popen(program, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                               cwd=ROOT, env=os.environ | {"LIMBER_CORES": "2"})
    family = psutil.Process(process.pid)
    deadline = time.monotonic() + 240
    while sum(_computes(p) for p in family.children()) < 2:
        assert process.poll() is None, "it ended before it was killed"
        assert time.monotonic() < deadline
        time.sleep(0.02)
    started = family.children(recursive=True)
    process.send_signal(kind)
    code = process.wait(30)
    _gone, alive = psutil.wait_procs(started, timeout=10)
    assert not [p for p in alive if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]
    return code


def _computes(process: psutil.Process) -> bool:
    """Whether it loads what it needs or works already: on a fast machine both take 0.8 s."""
    try:
        return process.cpu_times().user > 0.4
    except psutil.NoSuchProcess:
        return False


def assert_clean(folder: Path) -> None:
    Branch.open(folder, verify=True)
    left = [p.name for p in folder.iterdir()
            if is_owned_name(p.name) or p.name in (".commit", ".run.json")]
    assert not left


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_energy_leaves_no_process_and_a_folder_to_go_on_with(folder, kind):
    """Earlier results stand; the next run sweeps what was left, and finds what it always finds."""
    before = (folder / "energy.npz").read_bytes()
    code = killed_at_work(command("energy", folder, "--samples", 2200), kind)
    assert code == (130 if kind == signal.SIGTERM else -kind)
    assert (folder / "energy.npz").read_bytes() == before
    run("energy", folder, "--samples", "60", "--force")
    assert_clean(folder)
    with np.load(folder / "energy.npz") as now, np.load(io.BytesIO(before)) as then:
        assert set(then) == set(now)
        for name in then:
            assert_same(now[name], then[name], name)


def assert_same(now: np.ndarray, then: np.ndarray, name: str) -> None:
    """Grasps to the bit. Kernels and BLAS of two processes may differ in the last digit, which
    solved states carry on to the solver's tolerance and fitted weights times their condition."""
    if name == "poses" or now.dtype.kind not in "fc":
        np.testing.assert_array_equal(now, then, name)
    else:
        rtol = 1e-3 if "weights" in name else 1e-6
        np.testing.assert_allclose(now, then, rtol, rtol * np.nanmax(np.abs(then), initial=0.0),
                                   err_msg=name)


@pytest.mark.campaign
@pytest.mark.usefixtures("coarse_bound")
@pytest.mark.parametrize("kind", [signal.SIGTERM, signal.SIGKILL])
def test_a_killed_plan_leaves_no_process_and_a_folder_to_go_on_with(folder, kind):
    """While the motion is simulated, there and back."""
    ask = (folder, "--start-seed", "3", "--max-force", "1e3", "--name", "new")
    before = Branch.open(folder).names("plans")
    killed_at_work(command("plan", *ask), kind)
    assert Branch.open(folder, verify=True).names("plans") == before
    run("plan", *ask)
    assert_clean(folder)
    assert len(Branch.open(folder).names("plans")) > len(before)


@pytest.mark.campaign
def test_a_killed_bench_leaves_no_process():
    killed_at_work([sys.executable, "-m", "benchmarks.table", "estimation", "--quick"],
                   signal.SIGKILL)
