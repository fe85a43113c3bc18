"""The main job as a user does it: every stage by its command, on one small generated branch.

The commands run in this process, which loads the kernels once; as processes they run where that is
what is tested, here and in tests/planning/test_killed.py, tests/batch and tests/core/processes.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.subjects.commands import answer

from limber.cli.main import call
from limber.store import Branch

# The fixture runs the whole pipeline within the first test, so the usual limit is too short.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]


def result_of(*arguments: object) -> dict:
    """Run a command line; returns its JSON result."""
    code, told = answer(*arguments)
    assert code == 0, told
    return told


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> tuple[Path, dict[str, dict]]:
    """A branch folder after every stage, and each stage's JSON result."""
    folder = tmp_path_factory.mktemp("pipeline")
    branch = folder / "small.branch"
    results = {}

    def stage(name: str, *arguments: object) -> None:
        results[name] = result_of(name, *arguments)
    stage("generate", folder / "scan", "--seed", 3, "--length", 0.5, "--fork-count", 1)
    stage("reconstruct", folder / "scan" / "cloud.ply", "-o", branch, "--mesh-spacing", 4)
    stage("virtual-pull", branch, "--name", "pull-1", "--seed", 3)
    stage("estimate", branch)
    stage("simulate", branch)
    stage("energy", branch, "--samples", 40, "--seed", 3)
    stage("plan", branch, "--name", "to-goal", "--seed", 3)
    stage("scene", branch, "-o", folder / "scene.blend", "--render", folder / "scene.png",
          "--width", 320)
    stage("report", branch, "--picture", folder / "scene.png")
    assert "NaN" not in json.dumps(results)
    return branch, results


def test_modulus_is_recovered(done):
    """The pull was simulated on the true geometry; the estimate is near its modulus.

    The reconstructed radii enter by their fourth power, so this is no tight bound: 8 % of radius
    are 36 % of modulus.
    """
    _, results = done
    ratio = np.array(results["estimate"]["young_pa"]) / results["virtual-pull"]["young_true_pa"]
    assert results["estimate"]["converged"]
    assert np.abs(np.log(ratio)).max() < np.log(1.6)


def test_deformation_aware_path_saves_energy(done):
    """D-RRT* has no more energy along its path than RRT*, to the same goal, both by full model."""
    _, results = done
    plan = results["plan"]
    assert plan["plan"]["energy_integral_jm"] <= plan["baseline"]["energy_integral_jm"] * 1.02
    assert results["simulate"]["min_det_f"] > 0


def test_report_is_whole_and_self_contained(done):
    """The page has every section, embeds its pictures, and asks nothing of a network."""
    branch, results = done
    html = (branch / "report.html").read_text(encoding="utf-8")
    assert results["report"]["missing"] == []
    assert results["report"]["figure_count"] >= 8
    assert html.count("data:image/png;base64,") == results["report"]["figure_count"]
    assert "src=\"http" not in html
    assert "This pull was simulated" in html


def test_picture_shows_something(done):
    """The render is a PNG with many colours: a branch, not an empty background."""
    from PIL import Image

    branch, _ = done
    with Image.open(branch.parent / "scene.png") as image:
        colours = np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0)
        assert min(image.size) >= 240
    assert len(colours) > 500


def test_second_run_computes_nothing(done):
    """A stage whose input and settings have not changed is skipped and gives the same result."""
    branch, results = done
    before = {path: path.stat().st_mtime_ns for path in branch.rglob("*") if path.is_file()}
    again = result_of("reconstruct", branch.parent / "scan" / "cloud.ply", "-o", branch,
                      "--mesh-spacing", 4)
    assert again["tet_count"] == results["reconstruct"]["tet_count"]
    assert {path: path.stat().st_mtime_ns for path in branch.rglob("*") if path.is_file()} == before
    Branch.open(branch, verify=True)


def test_folder_can_be_moved(done, tmp_path):
    """A copy elsewhere verifies, is up to date, and goes on from where it was."""
    branch, results = done
    moved = tmp_path / "elsewhere" / "small.branch"
    shutil.copytree(branch, moved)
    Branch.open(moved, verify=True)
    page = (moved / "report.html").stat().st_mtime_ns
    told = result_of("report", moved, "--picture", branch.parent / "scene.png")
    assert told["sections"] == results["report"]["sections"]
    assert (moved / "report.html").stat().st_mtime_ns == page
    assert result_of("predict", moved, "--weight", 0.1)["drop_m"] > 0


def test_bad_cloud_costs_no_result(done, tmp_path):
    """A truncated cloud on an existing folder ends with 2 and leaves every file as it was."""
    branch, _ = done
    bad = tmp_path / "bad.ply"
    bad.write_bytes((branch / "cloud.ply").read_bytes()[:300])
    before = {p: p.read_bytes() for p in branch.rglob("*") if p.is_file()}
    assert call(["reconstruct", str(bad), "-o", str(branch)]) == 2
    assert {p: p.read_bytes() for p in branch.rglob("*") if p.is_file()} == before


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
@pytest.mark.parametrize(("stage", "options"), [("estimate", ["--force"]), pytest.param(
    "energy", ["--force", "--samples", "200"], marks=pytest.mark.campaign)])
def test_ctrl_c_in_a_stage_keeps_the_folder(done, tmp_path, stage: str, options: list[str]):
    """Ctrl-C in the middle of a stage ends with 130; the folder verifies, its files unchanged."""
    branch = tmp_path / "copy.branch"
    shutil.copytree(done[0], branch)
    before = {p.name: p.read_bytes() for p in branch.rglob("*") if p.is_file()}
    process = subprocess.Popen(
        [sys.executable, "-m", "limber", stage, str(branch), *options, "--json", "--progress",
         "json"], stdout=subprocess.PIPE, text=True, stderr=subprocess.DEVNULL)
    for line in process.stdout:
        content = json.loads(line) if line.startswith("{") else {}
        if content.get("progress", 0) > 0.2:
            break
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=30)
    assert process.returncode == 130
    assert json.loads(out.splitlines()[-1])["status"] == "cancelled"
    Branch.open(branch, verify=True)
    after = {p.name: p.read_bytes() for p in branch.rglob("*") if p.is_file()}
    assert {name: after[name] for name in before} == before
