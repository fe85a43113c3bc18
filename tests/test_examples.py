"""The scripts that users copy, and the README's Python, do what they say."""

import contextlib
import importlib.util
import io
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from tests.golden.references import small_parts

import limber
from limber.batch.job_file import read_jobs
from limber.batch.run import run_task
from limber.core.progress import SILENT
from limber.recordings.recording import read_pull
from limber.stages.pulls.export_pull import ExportPull

ROOT = Path(__file__).parents[1]
SCRIPTS = ROOT / "scripts" / "examples"
EXAMPLE = ROOT / "blend_files" / "bending_branch"
LIMBER = os.environ | {"LIMBER": f"{sys.executable} -m limber"}


def run(*command: object, **environment: str) -> str:
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False,
                          timeout=250, env=LIMBER | environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def run_here(code: str, folder: Path) -> str:
    """Run Python as a script in a folder, with few samples and cells; returns what it prints."""
    told = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(told), small_parts():
        exec(code, {"__name__": "__main__"})
    return told.getvalue()


def test_all_are_run_here():
    assert {path.name for path in SCRIPTS.iterdir()} == {
        "estimate.sh", "render.sh", "bend.py", "night.toml", "scan_to_plan.ipynb", "pull",
        "ros2", "paper.py"}


@pytest.mark.slow
def test_the_tables_to_copy_are_a_pull(tmp_path):
    """Those that the guide's page on pulls offers belong to an example branch."""
    branch = limber.open(shutil.copytree(ROOT / "blend_files" / "mature", tmp_path / "a.branch"))
    pull = branch.add_pull(SCRIPTS / "pull" / "markers.csv", "copied", quiet=True,
                           robot=str(SCRIPTS / "pull" / "robot.csv"))
    assert pull.poses.shape == (24, 6) and pull.markers.shape == (24, 4, 3)


@pytest.mark.slow
def test_the_guides_lines_for_mujoco(tmp_path):
    """The exported branch loads, and its outermost link is where a branch is."""
    pytest.importorskip("mujoco", reason="the extra test is not installed")
    text = (ROOT / "worker/docs/howto/exchange.md").read_text(encoding="utf-8")
    block, = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    limber.open(shutil.copytree(EXAMPLE, tmp_path / "a.branch")).export(tmp_path / "apple.xml")
    place = np.array(run_here(block, tmp_path).strip("[]\n ").split(), float)
    assert len(place) == 3 and 0.05 < np.linalg.norm(place) < 1


@pytest.mark.slow
def test_the_core_in_ten_lines(tmp_path):
    """Further out it holds more energy and pulls harder."""
    folder = shutil.copytree(EXAMPLE, tmp_path / "a.branch")
    with patch.object(sys, "argv", ["bend.py", str(folder)]):
        told = run_here((SCRIPTS / "bend.py").read_text(encoding="utf-8"), tmp_path)
    told = re.findall(r"(\d+) mm: (\S+) J, \[(.+)\] N", told)
    ways, energies, *forces = np.array([" ".join(row).split() for row in told], float).T
    assert ways.tolist() == [5, 10, 15] and 0 < energies[0] < energies[1] < energies[2]
    assert 0 < np.linalg.norm(forces, axis=0)[0] < np.linalg.norm(forces, axis=0)[2]
    text = (SCRIPTS / "bend.py").read_text().split('"""')[2]
    assert len([line for line in text.splitlines() if line.strip()]) <= 10


@pytest.mark.campaign
@pytest.mark.filterwarnings("ignore")
def test_the_paper_section_by_section(tmp_path):
    """One of its branches: each modulus in its interval; D-RRT* saves energy, the gentle path more.
    A second call finds all of it done."""
    code = (SCRIPTS / "paper.py").read_text(encoding="utf-8")
    asked = ["paper.py", "out", "--trials", "4", "--branches", "artificial"]
    with patch.object(sys, "argv", asked):
        told = run_here(code, tmp_path)
        assert run_here(code, tmp_path) == told
    row, _ = re.findall(r"^artificial +(.+\))$", told, re.MULTILINE)
    each = re.findall(r"(\S+) \((\S+) to (\S+); (\S+)\)", row)
    assert len(each) == 4
    assert all(float(low) < float(true) < float(high) for _, low, high, true in each)
    saved, gentle = re.search(r"([\d.]+) %  \(gentle path: \S+ %, ([\d.]+) %\)", told).groups()
    assert 0 < float(saved) < float(gentle)
    assert (tmp_path / "out" / "paper.png").read_bytes().startswith(b"\x89PNG")


def notebook_code() -> list[str]:
    """The code cells of the notebook."""
    content = json.loads((SCRIPTS / "scan_to_plan.ipynb").read_text(encoding="utf-8"))
    assert (content["nbformat"], content["nbformat_minor"]) == (4, 5)
    for cell in content["cells"]:
        assert {"cell_type", "id", "metadata", "source"} <= set(cell)
        assert cell["cell_type"] == "markdown" or cell["outputs"] == []
    return ["".join(cell["source"]) for cell in content["cells"] if cell["cell_type"] == "code"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_notebook(tmp_path):
    """From a scan to a plan with a picture in eight lines; the modulus is about the true one."""
    first, *others = notebook_code()
    assert len([line for line in first.splitlines() if line.strip()]) <= 8
    first = first.replace("length=0.4, fork_count=1", "length=0.3, fork_count=0")  # half the time
    assert "fork_count=0" in first
    # A cell's last line is what a notebook shows.
    told = run_here("\n".join(
        f"{cell.rpartition(chr(10))[0]}\n({cell.rpartition(chr(10))[2]}).savefig('{number}.png')"
        for number, cell in enumerate((first, *others))), tmp_path)
    assert told.startswith("Estimate(Young's modulus ") and ") MPa, " in told
    assert "% above the best" in told
    for number in range(len(others) + 1):
        assert (tmp_path / f"{number}.png").read_bytes().startswith(b"\x89PNG")
    true = json.loads((tmp_path / "scan" / "truth.json").read_text())["young_pa"]
    told = json.loads((tmp_path / "apple.branch" / "estimate.json").read_text())["young_pa"]
    assert np.abs(np.log(np.array(told) / true)).max() < np.log(1.6)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_python_of_readme_and_guide(tmp_path):
    """Its block is the notebook's, run above; the guide's run in a folder with their branch."""
    def blocks_of(path):
        return re.findall(r"^```python\n(.*?)^```", (ROOT / path).read_text(encoding="utf-8"),
                          re.MULTILINE | re.DOTALL)
    assert [block.strip() for block in blocks_of("README.md")] == [notebook_code()[0].strip()]
    blocks = blocks_of("worker/docs/reference/python.md")
    assert blocks
    shutil.copytree(EXAMPLE, tmp_path / "apple.branch")
    run_here("\n".join(blocks), tmp_path)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="the script is bash's")
def test_headless_estimation(branch_folder, tmp_path):
    """A recording becomes a pull, and the estimate's JSON stands beside the folder."""
    recording = tmp_path / "pull-2.mcap"
    ExportPull(branch_folder=branch_folder, name="pull-1", mcap=recording).run()
    run("bash", SCRIPTS / "estimate.sh", branch_folder, recording, ESTIMATE=(
        "--pull pull-2 --fractions 0.2,0.4,0.6,0.8 --quick"))
    told = json.loads((tmp_path / "small-estimate.json").read_text())
    assert told["status"] == "done" and told["converged"] and min(told["young_pa"]) > 0
    assert len(read_pull(branch_folder / "pulls" / "pull-2").times) > 10


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None or importlib.util.find_spec("bpy") is None,
                    reason="the script is bash's, and needs bpy")
def test_rendering(tmp_path):
    """A scene, a picture and a turntable whose sides differ."""
    from PIL import Image, ImageSequence

    folder = shutil.copytree(EXAMPLE, tmp_path / "a.branch")
    run("bash", SCRIPTS / "render.sh", folder, WIDTH="160", SIDES="2")
    assert (tmp_path / "a.blend").stat().st_size > 10_000
    assert (tmp_path / "a.png").stat().st_size > 2000
    with Image.open(tmp_path / "a.webp") as moving:
        assert moving.n_frames == 2 and moving.size == (160, 120)
        first, second = (np.asarray(side.convert("L"), float)
                         for side in ImageSequence.Iterator(moving))
    assert np.abs(second - first).max() > 30


@pytest.mark.slow
def test_the_job_file(tmp_path):
    """It is checked whole, and takes the tables that the guide offers: two make one pull."""
    shutil.copyfile(SCRIPTS / "night.toml", tmp_path / "night.toml")
    for name in ("scans/apple.ply", "scans/pear.ply"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    for folder in ("apple", "pear"):
        for kind in ("markers", "robot"):
            for name in ("one", "two")[:1 + (folder == "apple")]:
                path = tmp_path / "pulls" / folder / kind / f"{name}.csv"
                path.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(SCRIPTS / "pull" / f"{kind}.csv", path)
    apple, _ = read_jobs(tmp_path / "night.toml").branches
    assert [task.label for task in apple.tasks] == [
        "reconstruct", "import-pull:one", "import-pull:two", "estimate", "report", "scene"]
    assert apple.tasks[-1].render == tmp_path / "results" / "apple.png"
    shutil.copytree(ROOT / "blend_files" / "mature", apple.folder)
    for task in apple.tasks[1:3]:
        record = run_task(task, apple.folder, SILENT)
        assert not record.error and record.numbers["frame_count"] == 24
    pull = read_pull(apple.folder / "pulls" / "two")
    assert np.isfinite(pull.wrenches[:, :3]).all() and pull.observations.point_count == 4
