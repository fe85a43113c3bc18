"""The job file: what it says, what is wrong with it and in which line, and that it stays inside."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from limber.batch.job_file import fingerprint, read_jobs, toml_lines, why_not_in_batches
from limber.batch.scheduler_scripts import commands, write_script
from limber.core.errors import InputError
from limber.core.units import in_unit
from limber.stages.registry import stage_class, stage_summaries
from limber.store import Branch


@pytest.fixture
def write(tmp_path):
    """A function that writes a job file beside two scans and their recordings."""
    for name in ("scans/apple.ply", "scans/pear.ply", "pulls/apple/one.csv", "pulls/apple/two.csv",
                 "pulls/pear/one.csv"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")

    def write(text):
        (tmp_path / "jobs.toml").write_text(text)
        return tmp_path / "jobs.toml"
    return write


SCANS = """
[[job]]
scans = ["scans/*.ply"]
[[job.stage]]
run = "reconstruct"
"""


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_jobs(path)
    return str(caught.value)


def test_a_branch_for_each_scan_with_its_recordings(write, tmp_path):
    """Patterns make branches and runs; {scan} and {file} are their names; units are converted."""
    jobs = read_jobs(write('out = "results"\nworkers = 3\ntime_limit = "2 min"\n'
                           'memory_limit = "1.5 GB"\n' + SCANS + """
unit = "mm"
density = "0.8 g/cm^3"
up = [0, -1, 0]
[[job.stage]]
run = "import-pull"
source = "pulls/{scan}/*.csv"
name = "{file}"
grasp_radius = "8 mm"
[[job.stage]]
run = "estimate"
fractions = [0.3, 0.7]
"""))
    assert jobs.out == tmp_path / "results" and jobs.workers == 3
    assert (jobs.limits.seconds, jobs.limits.memory_mb) == (120.0, 1500.0)
    apple, pear = jobs.branches
    assert [task.label for task in apple.tasks] == [
        "reconstruct", "import-pull:one", "import-pull:two", "estimate"]
    assert [task.label for task in pear.tasks] == ["reconstruct", "import-pull:one", "estimate"]
    assert apple.folder == tmp_path / "results" / "apple.branch"
    first, pull = apple.tasks[:2]
    assert first.cloud == tmp_path / "scans/apple.ply"
    assert first.output == apple.folder
    assert first.density == pytest.approx(800.0) and first.up == (0, -1, 0)
    assert pull.grasp_radius == pytest.approx(0.008)
    assert pull.branch_folder == apple.folder
    assert apple.tasks[-1].fractions == (0.3, 0.7)


def test_files_named_in_settings_lie_beside_the_job_file(write, tmp_path):
    """They were looked for in the folder in which limber batch was started."""
    files = {"robot": "one.csv", "nominal": "rest.csv", "cell": "cell.toml",
             "pull_toml": "mine.toml", "yolo_weights": "own.pt"}
    stated = "\n".join(f'{key} = "{{scan}}/{name}"' for key, name in files.items())
    jobs = read_jobs(write(f"""{SCANS}
[[job.stage]]
run = "import-pull"
source = "pulls/{{scan}}/one.csv"
name = "one"
{stated}
"""))
    settings = jobs.branches[0].tasks[1]
    assert {key: getattr(settings, key) for key in files} == {
        key: tmp_path / "apple" / name for key, name in files.items()}


def test_a_sweep_is_every_combination(write):
    """Each has a branch of its own, named after its values."""
    jobs = read_jobs(write(SCANS + """
[job.sweep]
"reconstruct.mesh_spacing" = [2, 3.5]
"reconstruct.leaves" = ["cut", "keep"]
"""))
    assert [branch.name for branch in jobs.branches[:4]] == [
        "apple-mesh_spacing-2-leaves-cut", "apple-mesh_spacing-2-leaves-keep",
        "apple-mesh_spacing-3.5-leaves-cut", "apple-mesh_spacing-3.5-leaves-keep"]
    assert len(jobs.branches) == 8
    assert jobs.branches[3].tasks[0].mesh_spacing == 3.5
    assert len({fingerprint(branch.tasks[0]) for branch in jobs.branches}) == 8


@pytest.mark.parametrize(("text", "line", "said"), [
    ('outt = "x"', 1, "Did you mean out?"),
    ("workers = 0", 1, "at least 1"),
    ('workers = "two"', 1, "a whole number"),
    ('time_limit = "3 MB"', 1, "time_limit '3 MB': it must be in s or ms or min or h"),
    ("memory_limit = -5", 1, "not a positive number"),
    ("[[job]]\nscan = 1", 2, "Did you mean scans?"),
    ("[[job]]\n[[job.stage]]\nrun = 'reconstruct'", 1, "either scans or folders"),
    ("[[job]]\nscans = ['none*.ply']\n[[job.stage]]\nrun = 'reconstruct'", 2, "No file matches"),
    ("[[job]]\nscans = ['scans/*.ply']", 1, "no [[job.stage]]"),
    (SCANS + "\n# a comment\ngap_factr = 2", 8, "Did you mean gap_factor"),
    (SCANS + "gap_factor = -1", 6, "greater than 1"),
    (SCANS + "gap_factor = [1, 2]", 6, "it must be a number"),
    (SCANS + 'density = "8 mm"', 6, "density: it must be in kg/m^3 or g/cm^3, not '8 mm'"),
    (SCANS + 'gap_factor = "8 mm"', 6, "it has no unit"),
    (SCANS + 'unit = "yd"', 6, "it must be m, cm, mm, in or um, not 'yd'"),
    (SCANS + 'output = "x"', 6, "The batch sets"),
    (SCANS + '[[job.stage]]\nrun = "reconstuct"', 7, "Did you mean reconstruct?"),
    (SCANS + '[[job.stage]]\nrun = ["mesh"]', 7, "this stage does not exist"),
    (SCANS + '[[job.stage]]\nrun = "record"', 7, "It moves a robot"),
    (SCANS + '[[job.stage]]\nrun = "generate"', 7, "It makes a scan"),
    (SCANS + '[[job.stage]]\nrun = "import-pull"\nsource = "pulls/{scan}/*.c3d"\nname = "a"', 8,
     "no file matches"),
    (SCANS + '[[job.stage]]\nrun = "import-pull"\nsource = "a.csv"', 6, "it is missing"),
    (SCANS + '[[job.stage]]\nrun = "target"\nname = "{branch}"', 8, "Use {scan} or {file}"),
    (SCANS + '[job.sweep]\n"reconstruct.mesh_spacing" = 3', 7, "needs a list"),
    (SCANS + '[job.sweep]\n"mesh_spacing" = [3]', 7, "does not name a stage"),
    (SCANS + '[job.sweep]\n"reconstruct.mesh_spacing" = [3, "5 mm"]', 7, "it has no unit"),
    (SCANS + '[[job.stage]]\nrun = "scene"\noutput = "../../evil.blend"', 8, "is outside"),
    (SCANS + '[[job.stage]]\nrun = "scene"\noutput = "/tmp/evil.blend"', 8, "is outside"),
    ("[job]\nscans = []", 1, "[[job]]"),
])
def test_what_is_wrong_is_told_with_its_line(write, text, line, said):
    """Before anything runs, and without a folder made."""
    path = write(text)
    told = refusal(path)
    assert f"line {line}:" in told and said in told, told
    assert not (path.parent / "jobs").exists()


def test_every_problem_is_told_at_once(write):
    told = refusal(write('outt = 1\n' + SCANS + "gap_factor = -1\nmesh_side = 3\n"))
    assert [word for word in ("line 1:", "line 7:", "line 8:") if word in told] == [
        "line 1:", "line 7:", "line 8:"]


@pytest.mark.parametrize("content", [b"\xff\xfe", b"[[job", b"a = 1e400\nb=", b"[" * 5000])
def test_no_toml_is_refused(tmp_path, content):
    (tmp_path / "bad.toml").write_bytes(content)
    assert "bad.toml" in refusal(tmp_path / "bad.toml")


def test_names_cannot_lead_out(write, tmp_path):
    """A scan called like a way out, a sweep value with slashes: plain names inside ``out``."""
    (tmp_path / "scans" / "...ply").write_text("")
    jobs = read_jobs(write(SCANS + """
[[job.stage]]
run = "simulate"
kind = "static"
[job.sweep]
"simulate.name" = ["a", "b"]
"""))
    inside = (tmp_path / "jobs").resolve()
    for branch in jobs.branches:
        assert branch.folder.resolve().parent == inside
    told = refusal(write(SCANS + '[[job.stage]]\nrun = "simulate"\nname = "../../x"'))
    assert "line 8:" in told


def test_two_branches_never_share_a_folder(write, tmp_path):
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "apple.ply").write_text("")
    told = refusal(write(SCANS.replace('"scans/*.ply"', '"scans/*.ply", "more/*.ply"')))
    assert "2 branches would be named apple.branch" in told


def test_another_scans_branch_is_not_replaced(write, tmp_path):
    """One of an earlier job file, from a scan of the same stem."""
    folder = tmp_path / "jobs" / "apple.branch"
    Branch.create(folder)
    content = json.loads((folder / "branch.json").read_text())
    (folder / "branch.json").write_text(json.dumps(content | {"source": {"file": "apple.xyz"}}))
    told = refusal(write(SCANS))
    assert "apple.branch was made from apple.xyz, not from apple.ply" in told


def test_no_two_results_share_a_name(write, tmp_path):
    """Names that differ in suffix or case only; an output without the branch's name."""
    (tmp_path / "scans" / "Apple.xyz").write_text("")
    (tmp_path / "pulls" / "apple" / "one.mcap").write_text("")
    told = refusal(write(SCANS.replace("*.ply", "*.*") + """
[[job.stage]]
run = "import-pull"
source = "pulls/apple/*"
name = "{file}"
[[job.stage]]
run = "import-pull"
source = "pulls/apple/*.csv"
name = "always"
[[job.stage]]
run = "export"
output = "all.obj"
"""))
    assert "2 branches would be named" in told and "Apple" in told
    assert "line 7: 2 runs of import-pull on apple would have one result, pull:one" in told
    assert "one.csv; one.mcap" in told
    assert "line 11: 2 runs of import-pull on apple would have one result, pull:always" in told
    assert "3 branches would write" in told and "all.obj" in told


def test_every_stage_may_stand_in_a_job_file(write, tmp_path):
    """Each but those that have a reason: its schema is all that is needed."""
    fit = [name for name in stage_summaries() if not why_not_in_batches(name)]
    assert set(stage_summaries()) - {*fit} == {"generate", "record", "execute"}
    for name in fit:
        own = {"branch_folder", "cloud", "surface"} | (set() if name == "export" else {"output"})
        needed = "".join(f'{key} = "x"\n' for key, about in stage_class(name).model_fields.items()
                         if about.is_required() and key not in own)
        jobs = read_jobs(write(f'[[job]]\nscans = ["scans/apple.ply"]\n[[job.stage]]\n'
                               f'run = "{name}"\n{needed}'))
        assert [task.about.name for task in jobs.branches[0].tasks] == [name]


def test_lines_of_nested_tables():
    lines = toml_lines('a = 1\n[b.c]\n"d e".f = 2\n[[g]]\n[[g.h]]\nx = [\n 1 ]\n[[g.h]]\nx = 2\n'
                       "[[g]]\n[[g.h]]\nx = 3\n")
    assert lines[("a",)] == 1 and lines[("b", "c", "d e", "f")] == 3
    assert [lines[("g", 0, "h", 0, "x")], lines[("g", 0, "h", 1, "x")],
            lines[("g", 1, "h", 0, "x")]] == [6, 9, 12]


@pytest.mark.parametrize(("value", "unit", "wanted"), [
    ("8 mm", "m", 0.008), ("2.5e8 Pa", "Pa", 2.5e8), ("0.1 GPa", "Pa", 1e8), (7, "m", 7),
    ("90 deg", "rad", 1.5707963267948966), (["1 cm", 2], "m", [0.01, 2]), ("auto", "", "auto")])
def test_units(value, unit, wanted):
    assert in_unit(value, unit) == pytest.approx(wanted) if wanted != "auto" else (
        in_unit(value, unit) == wanted)


def test_an_endless_sweep_is_refused_before_it_is_made(write):
    """A hundred values of eight settings: no memory is taken for their combinations."""
    values = list(range(1, 101))
    told = refusal(write(SCANS + "[job.sweep]\n" + "".join(
        f'"reconstruct.{name}" = {values}\n' for name in (
            "seed", "young", "density", "poisson", "up", "twig_radius", "gap_factor", "leaves"))))
    assert "The sweep has 1e+16 combinations" in told and "line 6" in told


# Scripts for clusters: what they run is what the batch would have run.

JOBS = '''
time_limit = "10 min"
memory_limit = "2 GB"
[[job]]
scans = ["scan {odd} name.xyz", "b.xyz"]
[[job.stage]]
run = "reconstruct"
unit = "mm"
up = [0.0, 1.0, 0.0]
[[job.stage]]
run = "estimate"
'''


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    for name in ("scan {odd} name.xyz", "b.xyz"):
        (tmp_path / name).write_text("0 0 0\n")
    path = tmp_path / "night.toml"
    path.write_text(JOBS.replace("scan {odd} name.xyz", "scan*name.xyz"))
    monkeypatch.chdir(tmp_path)
    return read_jobs(path)


def test_a_slurm_task_runs_its_branchs_stages(jobs, tmp_path):
    """Run by bash with a stand-in for limber: the arguments arrive whole, limits are told."""
    script = write_script(jobs, "slurm")
    text = script.read_text()
    assert "#SBATCH --array=0-1" in text and "#SBATCH --mem=2000M" in text
    assert "#SBATCH --time=20" in text, "ten minutes for each of two stages"
    stand_in = tmp_path / "bin" / "limber"
    stand_in.parent.mkdir()
    stand_in.write_text(f"#!{sys.executable}\nimport sys, json\n"
                        "open('calls', 'a').write(json.dumps(sys.argv[1:]) + '\\n')\n")
    stand_in.chmod(0o755)
    environment = os.environ | {"PATH": f"{stand_in.parent}{os.pathsep}{os.environ['PATH']}",
                                "SLURM_ARRAY_TASK_ID": "0"}
    subprocess.run(["bash", str(script)], check=True, env=environment, timeout=60)
    import json

    called = [json.loads(line) for line in (tmp_path / "calls").read_text().splitlines()]
    assert [words[0] for words in called] == ["reconstruct", "estimate"]
    assert ["--up", "0.0", "1.0", "0.0"] == called[0][called[0].index("--up"):][:4]
    beyond = subprocess.run(["bash", str(script)], env=environment | {"SLURM_ARRAY_TASK_ID": "9"},
                            capture_output=True, timeout=60, check=False)
    assert beyond.returncode == 2


def test_a_snakefile_has_a_rule_a_branch(jobs):
    """Each with its limits; braces in names are no wildcards."""
    text = write_script(jobs, "snakemake").read_text()
    assert text.count("\nrule branch_") == 2 and text.count("mem_mb=2000, runtime=20") == 2
    assert "{{odd}}" in text
    compile(text.split("shell: ")[1].splitlines()[0], "shell", "eval")
    assert commands(jobs.branches[1])[0].startswith("limber reconstruct ")
