"""A batch on a Dask cluster: loopback alone, a stage's own files, a lost worker made up for."""

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from limber.batch.batch_progress import Records
from limber.batch.job_file import read_jobs
from limber.cli import main
from limber.core.errors import InputError
from limber.stages.command_line import command_line
from limber.stages.pulls.virtual_pull import VirtualPull
from limber.stages.shape.reconstruct import Reconstruct

JOBS = """
out = "results"
workers = 2
cluster = "local"
[[job]]
folders = ["*.branch"]
[[job.stage]]
run = "virtual-pull"
name = "pull-2"
frames = 4
young = ["40 MPa", "22 MPa", "12 MPa", "3 MPa"]
"""


@pytest.mark.slow
def test_two_workers_on_loopback_one_killed(tmp_path, branch_template, monkeypatch):
    """Kill -9 of a worker at work costs a stage at most: one that had just ended is up to date
    at the next look. The files are those of the stage run alone."""
    pytest.importorskip("distributed")
    monkeypatch.setenv("LIMBER_CORES", "2")
    for name in ("one", "two"):
        shutil.copytree(branch_template, tmp_path / f"{name}.branch")
    alone = shutil.copytree(branch_template, tmp_path / "alone")
    path = tmp_path / "jobs.toml"
    path.write_text(JOBS)
    process = subprocess.Popen([sys.executable, "-m", "limber", "batch", str(path)],
                               stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    batch = psutil.Process(process.pid)
    # At work: a worker holds a branch.
    end = time.monotonic() + 60
    while not list(tmp_path.glob("*.branch/.run.json")) and time.monotonic() < end:
        assert process.poll() is None, process.stderr.read().decode()
        time.sleep(0.02)
    holder = json.loads(next(tmp_path.glob("*.branch/.run.json")).read_text())["process"]
    family = [batch, *batch.children(recursive=True)]
    heard = [link.laddr.ip for each in family for link in each.net_connections("inet")
             if link.status == psutil.CONN_LISTEN]
    assert heard and set(heard) == {"127.0.0.1"}
    worker = psutil.Process(holder).parent()
    assert worker.pid != process.pid
    worker.send_signal(signal.SIGKILL)
    _, told = process.communicate(timeout=120)
    assert process.returncode == 0, told.decode()
    jobs = read_jobs(path)
    records = Records(jobs)
    ends = sorted(records.of(b, t).status for b in jobs.branches for t in b.tasks)
    assert ends in (["done", "done"], ["done", "up to date"])
    task = jobs.branches[0].tasks[0]
    line = command_line(task.model_copy(update={"branch_folder": alone}))
    assert main.call([task.about.name, *line]) == 0
    expected = _digests(alone)
    assert _digests(tmp_path / "one.branch") == _digests(tmp_path / "two.branch") == expected


def _digests(folder: Path) -> dict[str, str]:
    files = json.loads((folder / "branch.json").read_text())["files"]
    assert "pulls/pull-2/robot.csv" in files
    return {name: entry["sha256"] for name, entry in files.items()}


def test_a_task_is_the_same_after_its_json():
    """Numbers to the last digit, vectors, switches, lists, paths that look like options."""
    for task in (VirtualPull(branch_folder=Path("-odd name.branch"), frames=4,
                             young=(4e7, 1 / 3e-7, 0.1 + 2e3, 3e6)),
                 Reconstruct(cloud=Path("a b.xyz"), output=Path("a.branch"), unit="mm",
                             up=(0.0, 1.0, 1e-17))):
        again = type(task).checked(json.loads(json.dumps(task.stated())))
        assert again == task and again.model_fields_set == task.model_fields_set


@pytest.mark.parametrize(("words", "told"), [
    (["--scheduler", "tcp://10.0.0.1:8786"], "not encrypted"),
    (["--scheduler", "tcp://example.org:8786"], "not encrypted"),
    (["--scheduler", "10.0.0.1"], "not the address"),
    (["--scheduler", "tls://127.0.0.1:1", "--cluster", "local"], "Omit one of them"),
    (["--cluster", "slurm"], "number of jobs to request"),
    (["--cluster", "slurm", "--workers", "2"], "sbatch is not on this computer"),
])
def test_what_cannot_or_shall_not_run_is_refused(words, told, tmp_path, branch_template, capsys,
                                                 monkeypatch):
    pytest.importorskip("dask_jobqueue")
    monkeypatch.setenv("PATH", str(tmp_path))
    path = tmp_path / "jobs.toml"
    path.write_text(JOBS.replace('workers = 2\ncluster = "local"\n', "").replace(
        "*.branch", branch_template.name))
    shutil.copytree(branch_template, tmp_path / branch_template.name)
    assert main.call(["batch", str(path), *words]) == 2
    assert told in capsys.readouterr().err


def test_an_unknown_cluster_is_named_with_its_line(tmp_path):
    path = tmp_path / "jobs.toml"
    path.write_text(JOBS.replace('"local"', '"slrum"'))
    with pytest.raises(InputError, match=r"line 4: cluster = 'slrum': Did you mean slurm"):
        read_jobs(path)
