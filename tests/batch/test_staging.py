"""Scans, branches and results at addresses (fsspec's memory, a disk): fetched, put, kept."""

import json
import shutil
import time
from pathlib import Path

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from fsspec.utils import infer_storage_options
from tests.subjects.commands import answer

from limber.batch.batch_progress import Records
from limber.batch.job_file import BranchJob, JobFile, read_jobs
from limber.batch.remote_files import checked_address, fetch, is_address, matching, plain_name
from limber.batch.run import run_jobs
from limber.batch.scheduler_scripts import write_script
from limber.batch.staging import bring_in, put_out
from limber.core.errors import BranchFolderError, Cancelled, InputError, WorkError
from limber.core.files.atomic import file_digest
from limber.store import Branch

BODY = "x_mm,y_mm,z_mm,width_mm,height_mm\n" + "".join(
    f"0,0,{z},{20 - z / 20},{20 - z / 20}\n" for z in range(0, 101, 25))


@pytest.fixture
def memory():
    """fsspec's memory, empty before and after."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    yield system
    system.store.clear()


def on() -> None:
    """Nobody wants it to stop."""


def test_what_is_an_address():
    assert is_address("s3://bucket/a") and is_address("file:///a/b")
    assert not is_address("C:/scans") and not is_address("/a/b") and not is_address("a")
    assert checked_address("s3://bucket/a/") == "s3://bucket/a"
    for wrong, told in (("zip://a.ply::s3://b/c.zip", "chain"),
                        ("s3://bucket/../a", r"contains `\.\.`"),
                        ("sftp://me:secret@host/a", "password"),
                        ("zip://a.ply::sftp://me:secret@host/a.zip", "password")):
        with pytest.raises(InputError, match=told) as caught:
            checked_address(wrong)
        assert "secret" not in str(caught.value)
    for name in ("s3://b/.hidden", "s3://b/a?x=1", "s3://b/a\\b", "s3://b/a\nb"):
        with pytest.raises(InputError, match="not a valid file name"):
            plain_name(name)


def test_a_file_is_fetched_once_until_it_changes(memory, tmp_path):
    memory.pipe_file("/in/a.csv", b"one")
    target = tmp_path / "here" / "a.csv"
    fetch("memory://in/a.csv", target, on)
    assert target.read_bytes() == b"one"
    target.write_bytes(b"ours")
    fetch("memory://in/a.csv", target, on)
    assert target.read_bytes() == b"ours", "it was fetched again though nothing has changed"
    time.sleep(0.002)
    memory.pipe_file("/in/a.csv", b"two")
    fetch("memory://in/a.csv", target, on)
    assert target.read_bytes() == b"two"


def test_a_transfer_that_is_stopped_or_fails_leaves_what_was_there(memory, tmp_path):
    """Whole or not at all; the next one sweeps nothing that lives and ends it."""
    memory.pipe_file("/in/a.csv", b"one")
    target = tmp_path / "a.csv"
    fetch("memory://in/a.csv", target, on)
    memory.pipe_file("/in/a.csv", b"second")

    def stop():
        raise Cancelled
    with pytest.raises(Cancelled):
        fetch("memory://in/a.csv", target, stop)
    assert target.read_bytes() == b"one"
    memory.rm("/in/a.csv")
    with pytest.raises(WorkError, match=r"memory://in/a\.csv does not exist"):
        fetch("memory://in/a.csv", target, on)
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".csv"] == ["a.csv"]
    with pytest.raises(InputError, match="not a usable address"):
        matching("nonsense://a/*")


class Hosted(MemoryFileSystem):
    """As fsspec has SFTP: the host belongs to the connection, and paths are without it."""

    protocol = "hosted"

    def __init__(self, host: str, **options):
        super().__init__(**options)
        self.host = host

    @classmethod
    def _strip_protocol(cls, path):
        return infer_storage_options(path)["path"].rstrip("/")

    @staticmethod
    def _get_kwargs_from_urls(address):
        return {"host": infer_storage_options(address)["host"]}


def test_what_a_pattern_stands_for_keeps_its_host(memory, tmp_path):
    fsspec.register_implementation("hosted", Hosted, clobber=True)
    memory.pipe_file("/scans/a.ply", b"one")
    assert matching("hosted://greenhouse/scans/*") == ["hosted://greenhouse/scans/a.ply"]
    fetch("hosted://greenhouse/scans/a.ply", tmp_path / "a.ply", on)
    fetch("hosted://greenhouse/scans", tmp_path / "scans", on)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "scans/a.ply").read_bytes() == b"one"


def test_a_folder_is_fetched_with_what_is_in_it(tmp_path):
    """A recording of several files, from a disk."""
    there = tmp_path / "there" / "pull"
    (there / "depth").mkdir(parents=True)
    (there / "depth" / "1.png").write_bytes(b"1")
    (there / "list.txt").write_bytes(b"2")
    fetch(there.as_uri(), tmp_path / "pull", on)
    assert (tmp_path / "pull" / "depth" / "1.png").read_bytes() == b"1"
    assert (tmp_path / "pull" / "list.txt").read_bytes() == b"2"


@pytest.fixture
def away(memory, tmp_path, branch_template):
    """A job of one branch whose folder is in fsspec's memory, and the job file it is of."""
    shutil.copytree(branch_template, tmp_path / "first.branch")
    job = BranchJob("a", tmp_path / "work" / "a.branch", (), home="memory://old/a.branch")
    jobs = JobFile(tmp_path / "jobs.toml", tmp_path / "work", (job,))
    put_out(jobs, BranchJob("a", tmp_path / "first.branch", (), home=job.home))
    return jobs, job


def noted(folder: Path, name: str) -> None:
    """Write a file into a branch by a stage."""
    with Branch.open(folder).stage(f"note:{name}") as stage:
        stage.path(f"notes/{name}.txt").write_text(name)


def test_a_branch_goes_there_and_back(away, memory, tmp_path):
    """What was done here is there, what was done there comes here, each file once."""
    jobs, job = away
    bring_in(job, on)
    assert Branch.open(job.folder, verify=True).uuid == Branch.open(tmp_path / "first.branch").uuid
    noted(job.folder, "here")
    written = memory.modified("/old/a.branch/mesh.vtu")
    put_out(jobs, job)
    assert memory.cat("/old/a.branch/notes/here.txt") == b"here"
    assert memory.modified("/old/a.branch/mesh.vtu") == written, "nothing new was put again"
    assert memory.cat("/old/a.branch/branch.json") == (job.folder / "branch.json").read_bytes()
    # Another computer goes on with it.
    other = BranchJob("a", tmp_path / "other" / "a.branch", (), home=job.home)
    bring_in(other, on)
    noted(other.folder, "there")
    put_out(jobs, other)
    bring_in(job, on)
    assert (job.folder / "notes" / "there.txt").read_text() == "there"
    # What is not put yet stays when it is asked for again.
    noted(job.folder, "later")
    bring_in(job, on)
    assert (job.folder / "notes" / "later.txt").is_file()


def test_a_branch_on_another_disk_is_a_branch_there(branch_template, tmp_path):
    """Its folders are made, and it opens there with all of its checksums right."""
    there = tmp_path / "disk" / "a.branch"
    job = BranchJob("a", branch_template, (), home=there.as_uri())
    put_out(JobFile(tmp_path / "jobs.toml", tmp_path, (job,)), job)
    assert Branch.open(there, verify=True).has("pulls/pull-1/pull.toml")


def test_two_that_worked_on_it_are_told(away, tmp_path):
    """Neither's results are overwritten."""
    jobs, job = away
    other = BranchJob("a", tmp_path / "other" / "a.branch", (), home=job.home)
    for one in (job, other):
        bring_in(one, on)
        noted(one.folder, one.folder.parent.name)
    put_out(jobs, job)
    for act in (lambda: put_out(jobs, other), lambda: bring_in(other, on)):
        with pytest.raises(BranchFolderError, match="are different branches"):
            act()
    assert (other.folder / "notes" / "other.txt").is_file()


def test_a_transfer_that_was_cut_off_is_seen_and_ended(away, memory, tmp_path):
    """New files with the old manifest: nobody takes them for the branch; the next run ends it."""
    _, job = away
    bring_in(job, on)
    old = memory.cat("/old/a.branch/mesh.vtu")
    memory.pipe_file("/old/a.branch/mesh.vtu", old + b" ")
    other = BranchJob("a", tmp_path / "other" / "a.branch", (), home=job.home)
    with pytest.raises(WorkError, match=r"mesh\.vtu differs from its manifest"):
        bring_in(other, on)
    assert not other.folder.exists()
    memory.pipe_file("/old/a.branch/branch.json", b"cut")
    with pytest.raises(BranchFolderError):
        bring_in(other, on)


@pytest.mark.parametrize("name", ["../../victim.txt", "/victim.txt", "C:/victim.txt"])
def test_a_branch_at_an_address_brings_no_file_outside_itself(away, memory, tmp_path, name):
    """Its manifest, and what stands beside it there, may come from anybody."""
    _, job = away
    content = json.loads(memory.cat("/old/a.branch/branch.json"))
    content["files"][name] = content["files"]["mesh.vtu"]
    memory.pipe_file("/old/a.branch/branch.json", json.dumps(content).encode())
    memory.pipe_file("/victim.txt", b"evil")
    other = BranchJob("a", tmp_path / "other" / "a.branch", (), home=job.home)
    with pytest.raises(BranchFolderError, match="lists a file"):
        bring_in(other, on)
    assert not other.folder.exists() and not list(tmp_path.rglob("victim.txt"))


def test_no_file_that_a_link_names_is_put_to_an_address(away, memory, tmp_path):
    """A link in the branch's folder would give away what it leads to."""
    jobs, job = away
    bring_in(job, on)
    (job.folder / "mesh.vtu").unlink()
    (job.folder / "mesh.vtu").symlink_to(tmp_path / "first.branch" / "branch.json")
    with pytest.raises(BranchFolderError, match="is a link"):
        put_out(jobs, job)


@pytest.mark.slow
def test_a_batch_from_addresses_to_an_address(memory, here, tmp_path, capsys):
    """Scans and results in fsspec's memory; again from nothing here it repeats no stage."""
    for name in ("one", "two"):
        memory.pipe_file(f"/scans/{name}.csv", BODY.encode())
    jobs = tmp_path / "jobs.toml"
    jobs.write_text("""
out = "memory://night"
work = "scratch"
[[job]]
scans = ["memory://scans/*.csv"]
[[job.stage]]
run = "mesh"
[[job.stage]]
run = "target"
name = "flower"
at = [0.0, 0.0, 0.1]
""")
    checked = read_jobs(jobs)
    assert checked.branches[0].fetched[0][0] == "memory://scans/one.csv"
    with pytest.raises(InputError, match="contains addresses"):
        write_script(checked, "slurm")
    # A scan that is gone costs its own branch alone.
    memory.rm("/scans/two.csv")
    records = Records(checked)
    run_jobs(checked, records, workers=1)
    (one, two) = ([records.of(branch, task) for task in branch.tasks]
                  for branch in checked.branches)
    assert [record.status for record in one] == ["done", "done"]
    assert two[0].status == "failed" and "memory://scans/two.csv does not exist" in two[0].error
    assert not memory.exists("/night/two.branch")
    memory.pipe_file("/scans/two.csv", BODY.encode())
    code, told = answer("batch", jobs, "--workers", "1", "--retry-failed")
    assert code == 0 and told["done"] == 2, told
    manifest = json.loads(memory.cat("/night/one.branch/branch.json"))
    assert {"mesh", "target:flower"} <= set(manifest["stages"])
    assert b"2 done" in memory.cat("/night/jobs.html") and memory.isfile("/night/jobs.csv")
    shutil.rmtree(tmp_path / "scratch")
    code, told = answer("batch", jobs, "--workers", "1")
    assert code == 0 and told["done"] == 2, told
    again = json.loads(memory.cat("/night/one.branch/branch.json"))
    assert again["stages"]["mesh"] == manifest["stages"]["mesh"]
    assert file_digest(tmp_path / "scratch" / "one.branch" / "mesh.vtu") == (
        manifest["files"]["mesh.vtu"]["sha256"])


def test_what_a_job_file_may_say_of_addresses(memory, tmp_path):
    memory.pipe_file("/scans/one.csv", BODY.encode())
    jobs = tmp_path / "jobs.toml"
    jobs.write_text('out = "here"\nwork = "scratch"\n[[job]]\nscans = ["memory://scans/*.csv", '
                    '"memory://none/*.ply"]\n[[job.stage]]\nrun = "mesh"\n'
                    '[[job.stage]]\nrun = "scene"\noutput = "memory://a.blend"\n')
    with pytest.raises(InputError) as caught:
        read_jobs(jobs)
    told = str(caught.value)
    assert "line 2: work must be a folder on this computer" in told
    assert "No file matches 'memory://none/*.ply'" in told
    assert "to `out` only" in told


def test_a_password_in_a_job_file_is_never_shown(tmp_path):
    """In none of the messages about the address that has it."""
    jobs = tmp_path / "jobs.toml"
    jobs.write_text('out = "here"\n[[job]]\nscans = ["sftp://me:secret@host/*.ply"]\n'
                    '[[job]]\nfolders = ["sftp://me:secret@host/*"]\n[[job.stage]]\n'
                    'run = "scene"\noutput = "sftp://me:secret@host/a.blend"\n')
    with pytest.raises(InputError) as caught:
        read_jobs(jobs)
    assert "host contains a password" in str(caught.value) and "secret" not in str(caught.value)
