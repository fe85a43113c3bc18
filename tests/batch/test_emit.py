"""Scripts for clusters: what they run is what the batch would have run."""

import os
import subprocess
import sys

import pytest

from limber.batch.job_file import read_jobs
from limber.batch.scheduler_scripts import commands, write_script

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
