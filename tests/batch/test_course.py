"""A batch on the pool: it resumes, keeps what is done, ends one branch alone by a failure."""

import csv
import html
import json
import shutil
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import psutil
import pytest
from tests.subjects.commands import answer

from limber.batch.batch_progress import Records, numbers_of, path_of_page, write_page
from limber.batch.job_file import read_jobs
from limber.batch.run import run_jobs
from limber.core.errors import BranchFolderError
from limber.stages.shape.target import SetTarget
from limber.store import Branch

JOBS = """
out = "results"
[[job]]
folders = ["*.branch"]
[[job.stage]]
run = "target"
name = "flower"
at = [0.0, 0.0, 0.2]
[[job.stage]]
run = "virtual-pull"
name = "pull-2"
frames = 4
young = ["40 MPa", "22 MPa", "12 MPa", "3 MPa"]
"""


def states(path: Path) -> list[list[str]]:
    jobs = read_jobs(path)
    records = Records(jobs)
    return [[records.of(branch, task).status for task in branch.tasks] for branch in jobs.branches]


@pytest.mark.slow
def test_run_fail_mend_and_resume(orchard, capsys):
    """A broken branch fails alone; what is done is kept; --retry-failed brings the rest."""
    jobs = orchard / "jobs.toml"
    mesh = orchard / "two.branch" / "mesh.vtu"
    good = mesh.read_bytes()
    mesh.write_bytes(b"broken")
    code, told = answer("batch", jobs, "--dry-run")
    assert code == 0 and [row[2] for row in told["planned"]] == ["to run"] * 4
    code, told = answer("batch", jobs, "--workers", "1")
    assert code == 3 and "1 of 2 branches failed: two; two: target:flower" in told["error"]
    assert states(jobs) == [["done", "done"], ["failed", "waiting"]]
    rows = list(csv.DictReader((orchard / "results/jobs.csv").open()))
    assert Branch.open(orchard / "one.branch").has("pulls/pull-2/pull.toml")
    code, told = answer("status", jobs)
    assert (told["done"], told["failed"], told["failures"][0][0]) == (1, 1, "two")
    # Mended, it is not tried again unasked; then it is, and the other one is kept as it is.
    mesh.write_bytes(good)
    before = (orchard / "one.branch" / "branch.json").read_bytes()
    assert answer("batch", jobs, "--workers", "1")[0] == 3
    code, told = answer("batch", jobs, "--workers", "1", "--retry-failed")
    assert code == 0 and told["done"] == 2, told
    assert states(jobs)[0][1] == "up to date" and states(jobs)[1] == ["done", "done"]
    rows_before, rows = rows, list(csv.DictReader((orchard / "results/jobs.csv").open()))
    assert rows[0]["virtual-pull:pull-2.seconds"] == rows_before[0]["virtual-pull:pull-2.seconds"]
    assert Branch.open(orchard / "one.branch").digest("pulls/pull-2/robot.csv") == json.loads(
        before)["files"]["pulls/pull-2/robot.csv"]["sha256"]
    rows = list(csv.DictReader((orchard / "results/jobs.csv").open()))
    assert [row["branch"] for row in rows] == ["one", "two"]
    assert float(rows[0]["virtual-pull:pull-2.peak_force_n"]) > 0
    assert float(rows[1]["virtual-pull:pull-2.memory_mb"]) > 10
    page = (orchard / "results/jobs.html").read_text()
    assert "2 done" in page and page.count("<svg class=sketch viewBox") == 4
    assert "href=" not in page, "no branch has a report"
    told = (orchard / "results/jobs.log").read_text()
    assert "two target:flower failed" in told and "one virtual-pull:pull-2 done after" in told


@pytest.mark.slow
def test_a_killed_batch_goes_on(orchard, here):
    """SIGKILL to the batch: nothing half made, a new run ends with what an undisturbed one has."""
    jobs = orchard / "jobs.toml"
    log = orchard / "results" / "jobs.jobs.jsonl"
    process = subprocess.Popen([sys.executable, "-m", "limber", "batch", str(jobs), "--workers",
                                "1"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    end = time.monotonic() + 60
    while not (log.is_file() and '"done"' in log.read_text()) and time.monotonic() < end:
        time.sleep(0.01)
    started = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not any("running" in row for row in states(jobs)), "what ran when it was killed waits"
    _gone, alive = psutil.wait_procs(started, timeout=10)
    assert not [p for p in alive if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]
    checked = read_jobs(jobs)
    run_jobs(checked, Records(checked), workers=1)
    found = states(jobs)
    assert {status for row in found for status in row} <= {"done", "up to date"}
    one, two = (Branch.open(orchard / f"{name}.branch", verify=True) for name in ("one", "two"))
    assert one.digest("pulls/pull-2/robot.csv") == two.digest("pulls/pull-2/robot.csv")


def test_what_is_written_beside_the_branch_is_not_written_again(orchard, here, capsys):
    """An export, as a scene, is made once, and again when the branch or the file has changed."""
    jobs = orchard / "jobs.toml"
    jobs.write_text(JOBS.split("[[job.stage]]\nrun = \"virtual", maxsplit=1)[0] +
                    '[[job.stage]]\nrun = "export"\noutput = "{scan}.swc"\n')
    ran: list[str] = []
    here.before = staticmethod(lambda task, folder: ran.append(f"{folder.stem} {task.label}"))
    try:
        for change, exported in ((None, ["one", "two"]), (None, []), ("file", ["one"]),
                                 ("branch", ["two"])):
            if change == "file":
                next(orchard.rglob("one.swc")).unlink()
            elif change == "branch":
                SetTarget(branch_folder=orchard / "two.branch", name="leaf",
                          at=(0.0, 0.0, 0.1)).run()
            ran.clear()
            assert answer("batch", jobs)[0] == 0
            assert [one.split()[0] for one in ran if "export" in one] == exported, change
            assert [row[-1] for row in states(jobs)] == [
                "done" if name in exported else "up to date" for name in ("one", "two")]
    finally:
        here.before = staticmethod(lambda task, folder: None)


def test_the_page_shows_what_was_rendered(orchard):
    """Pictures that `limber scene` has made of a branch, by ways that hold when all is moved."""
    jobs = orchard / "jobs.toml"
    jobs.write_text(JOBS + '[[job.stage]]\nrun = "scene"\n'
                    'output = "{scan}.blend"\nrender = "views/{scan} & co.png"\n')
    checked = read_jobs(jobs)
    (checked.out / "views").mkdir(parents=True)
    (checked.out / "views" / "one & co.png").write_bytes(b"")
    write_page(checked, Records(checked))
    page = path_of_page(checked).read_text()
    assert page.count("<img") == 1 and "<img src='views/one%20%26%20co.png'" in page


def test_two_batches_exclude_each_other(orchard):
    jobs = read_jobs(orchard / "jobs.toml")
    first, second = Records(jobs), Records(jobs)
    with first.writing(), pytest.raises(BranchFolderError, match="Another program"), (
            second.writing()):
        raise AssertionError
    damaged = first.path.read_text() + '{"branch": "one"}\nno json\n[' + "[" * 9999 + "\n"
    first.path.write_text(damaged)
    assert Records(jobs).of(jobs.branches[0], jobs.branches[0].tasks[0]).status == "waiting"


def test_records_and_log_stay_short(orchard, monkeypatch):
    """Of many runs each task's last line is kept; the log's oldest lines go."""
    from limber.batch import batch_progress

    jobs = read_jobs(orchard / "jobs.toml")
    held, branch = Records(jobs), jobs.branches[0]
    with held.writing():
        for number in range(40):
            held.end(branch, branch.tasks[0], batch_progress.Record("done", seconds=float(number)))
        held.begin(branch, branch.tasks[1])
    assert len(held.path.read_text().splitlines()) == 41
    monkeypatch.setattr(batch_progress, "_LEAST_LINES", 10)
    again = Records(jobs)
    with again.writing():
        assert len(held.path.read_text().splitlines()) == 2
    assert Records(jobs).of(branch, branch.tasks[0]).seconds == 39.0
    monkeypatch.setattr(batch_progress, "MOST_BYTES", 500)
    with closing(batch_progress.log_of(jobs)) as log:
        for number in range(100):
            batch_progress.tell(log, "one", f"line {number}\nof %s text")
    files = sorted(jobs.out.glob("jobs.log*"))
    assert [path.name for path in files] == ["jobs.log", *(f"jobs.log.{n}" for n in (1, 2, 3))]
    assert all(path.stat().st_size <= 500 for path in files)
    assert files[0].read_text().splitlines()[-1].endswith("one line 99 of %s text")


@pytest.mark.slow
def test_text_of_files_is_no_page_and_no_formula(orchard, here, capsys):
    """A branch named like a formula or a script is text in the table and on the page."""
    name = "=1+<b>"
    shutil.move(orchard / "two.branch", orchard / f"{name}.branch")
    (orchard / f"{name}.branch" / "mesh.vtu").write_bytes(b"")
    jobs = orchard / "jobs.toml"
    jobs.write_text(JOBS.replace('["*.branch"]', f'["{name}.branch"]'))
    assert answer("batch", jobs, "--workers", "1")[0] == 3
    row = next(csv.DictReader((orchard / "results/jobs.csv").open()))
    assert row["branch"] == f"'{name}"
    page = (orchard / "results/jobs.html").read_text()
    assert html.escape(name) in page and name not in page


def test_numbers_of_a_result():
    assert numbers_of({"a": 1, "b": True, "c": [1.5, 2], "d": "x", "e": None, "f": [[1]],
                       "g": list(range(99))}) == {"a": 1, "c_1": 1.5, "c_2": 2}


def test_pictures_of_a_branch(tmp_path, branch_template):
    """Two sides; coloured where the modulus varies, brown where it does not, none without axes."""
    from limber.batch.batch_progress import pictures

    example = Path(__file__).parents[2] / "blend_files" / "bending_branch"
    shown = pictures(example)
    assert shown.count("<svg") == 2 and "MPa (bright)</p>" in shown
    assert shown.count("<line") == 2 * (len(
        [line for line in (example / "skeleton.swc").read_text().splitlines()
         if line and not line.startswith("#")]) - 1)
    assert "(bright)" not in pictures(branch_template) and "<line" in pictures(branch_template)
    assert pictures(tmp_path) == "<div class=pictures></div>"
