"""A disk that is full, or a network folder that is lost, in the middle of a batch."""

import errno
import json
import os

import pytest

from limber.batch.batch_progress import Records
from limber.batch.job_file import read_jobs
from limber.cli import main
from limber.store import Branch, journal

JOBS = """
out = "results"
[[job]]
folders = ["*.branch"]
""" + "".join(f"""
[[job.stage]]
run = "target"
name = "{name}"
at = [0.0, 0.0, 0.2]
""" for name in ("flower", "fruit"))


@pytest.fixture
def batch(orchard, here, capsys):
    """Runs the batch; returns exit code, result and the state of each task."""
    def run(*more):
        code = main.call(["batch", str(orchard / "jobs.toml"), "--json", *more])
        told = json.loads(capsys.readouterr().out.splitlines()[-1])
        jobs = read_jobs(orchard / "jobs.toml")
        records = Records(jobs)
        return code, told, [[records.of(branch, task).status for task in branch.tasks]
                            for branch in jobs.branches]
    return run


def targets(orchard, name) -> list[str]:
    branch = Branch.open(orchard / f"{name}.branch", verify=True)
    if not branch.has("targets.json"):
        return []
    return [one["name"] for one in json.loads(branch.path("targets.json").read_text())["targets"]]


@pytest.mark.slow
def test_a_full_disk_ends_its_own_branch(orchard, batch, here, monkeypatch):
    flush = journal.flush_tree
    calls = []

    def full(work):
        calls.append(work)
        if len(calls) == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(work / "targets.json"))
        flush(work)
    with monkeypatch.context() as patch:
        patch.setattr(journal, "flush_tree", full)
        code, told, states = batch()
    assert code == 3 and "The disk is full" in told["error"], told
    assert states == [["done", "failed"], ["done", "done"]]
    assert targets(orchard, "one") == ["flower"] and targets(orchard, "two") == ["flower", "fruit"]
    kept = Branch.open(orchard / "two.branch").manifest.stages
    code, told, states = batch("--retry-failed")
    assert code == 0 and states[0] == ["up to date", "done"]
    assert targets(orchard, "one") == ["flower", "fruit"]
    assert Branch.open(orchard / "two.branch").manifest.stages == kept


def test_a_lost_branch_ends_alone(orchard, batch, here, monkeypatch):
    """It is not made anew, and when it is there again the batch goes on with it."""
    def lose(task, folder):
        if folder.name == "one.branch" and task.label.endswith("fruit"):
            folder.rename(orchard / "away")
    with monkeypatch.context() as patch:
        patch.setattr(here, "before", staticmethod(lose))
        code, told, _ = batch()
    assert code == 3 and "There is no folder" in told["error"]
    assert not (orchard / "one.branch").exists()
    assert targets(orchard, "two") == ["flower", "fruit"]
    (orchard / "away").rename(orchard / "one.branch")
    assert targets(orchard, "one") == ["flower"]
    code, told, states = batch("--retry-failed")
    assert code == 0 and states == [["up to date", "done"], ["up to date", "up to date"]], states


@pytest.mark.slow
@pytest.mark.parametrize("trouble", ["gone", "full"])
def test_lost_results_stop_the_batch(orchard, batch, here, monkeypatch, trouble):
    """Nothing is written where they were; back again, what is stored is not done again."""
    out = orchard / "results"

    def lose(task, folder):
        if folder.name == "one.branch" and task.label.endswith("fruit"):
            if trouble == "gone":
                out.rename(orchard / "away")
            else:
                from limber.store import journal
                patch.setattr(journal.os, "fsync", no_room)

    def no_room(_handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with monkeypatch.context() as patch:
        patch.setattr(here, "before", staticmethod(lose))
        code, told, _ = batch()
    assert code == 3, told
    if trouble == "gone":
        assert "results no longer exists" in told["error"]
        assert not out.exists()
        (orchard / "away").rename(out)
    else:
        assert "could not be written" in told["error"] and "Free some space" in told["error"], told
    before = Branch.open(orchard / "one.branch", verify=True).manifest.stages
    assert "target:flower" in before
    assert targets(orchard, "two") in ([], ["flower"], ["flower", "fruit"])
    code, told, states = batch("--retry-failed")
    assert code == 0 and all(one in ("done", "up to date") for row in states for one in row)
    after = Branch.open(orchard / "one.branch").manifest.stages
    assert all(after[key] == entry for key, entry in before.items())
    assert targets(orchard, "two") == ["flower", "fruit"]
