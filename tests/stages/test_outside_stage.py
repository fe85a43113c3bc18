"""A stage of another package: one file and its entry point are all that it takes."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from tests.stages.test_registry import parsed, sample

from limber.batch.job_file import read_jobs
from limber.batch.scheduler_scripts import commands
from limber.cli import main
from limber.core.errors import InputError
from limber.stages import registry
from limber.stages.stage import About, Stage
from limber.store import Branch

ROOT = Path(__file__).parents[2]
STAGE = '''from typing import Any, ClassVar

from pydantic import Field

from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups
from limber.stages.stage import About, BranchStage, Repeatable
from limber.store import Branch


class Count(Repeatable, BranchStage):
    """Count the nodes of the skeleton.

    Of every axis.
    """

    about = About("count", 27, key="count", reads=("skeleton.swc",), writes=("count.txt",),
                  step="skeleton", label="Count the Nodes")
    groups: ClassVar[Groups] = {"counting": ("least_radius",)}

    least_radius: float = Field(0.0, ge=0, description="Of the thicker ones alone [m].")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        branch = Branch.open(self.branch_folder)
        with branch.stage("count", self) as stage:
            (stage.path("count.txt")).write_text("3")
            stage.result = {"node_count": 3, "least_radius_m": self.least_radius}
        return branch.manifest.stages["count"].result
'''


@pytest.fixture()
def package(tmp_path, monkeypatch):
    """A package that is installed beside Limber; its stage is `count`."""
    folder = tmp_path / "site"
    (folder / "counting").mkdir(parents=True)
    (folder / "counting" / "__init__.py").write_text("")
    (folder / "counting" / "count.py").write_text(STAGE)
    (folder / "counting-1.0.dist-info").mkdir()
    (folder / "counting-1.0.dist-info" / "METADATA").write_text("Name: counting\nVersion: 1.0\n")
    (folder / "counting-1.0.dist-info" / "entry_points.txt").write_text(
        "[limber.stages]\ncount = counting.count:Count\n")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), str(ROOT / "worker")]))
    registry._stages.cache_clear()
    yield folder
    registry._stages.cache_clear()
    for name in ("counting", "counting.count"):
        sys.modules.pop(name, None)


def test_its_command_runs_and_makes_its_entry(package, tmp_path, capsys):
    """As any other stage's: options, result, manifest."""
    Branch.create(tmp_path / "a.branch")
    assert main.call(["count", str(tmp_path / "a.branch"), "--least-radius", "0.004",
                      "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["status"] == "done" and told["least_radius_m"] == 0.004
    entry = Branch.open(tmp_path / "a.branch").manifest.stages["count"]
    assert entry.settings == {"least_radius": 0.004}
    assert (tmp_path / "a.branch" / "count.txt").read_text() == "3"
    stage = sample("count")
    assert parsed("count", [str(stage.branch_folder), "--force"]) == stage


def test_it_is_in_the_help_before_anything_is_imported(package):
    """In its place; neither it nor a numerical package is loaded for `limber --help`."""
    done = subprocess.run(
        [sys.executable, "-c", "import sys; from limber.cli.main import call; call(['--help']); "
         "print(*sys.modules, file=sys.stderr)"], capture_output=True, text=True, check=True)
    lines = [line.split() for line in done.stdout.splitlines() if line.startswith("  ")]
    names = [words[0] for words in lines if words]
    assert names.index("skeleton") < names.index("count") < names.index("mesh")
    assert ["count", "Count", "the", "nodes", "of", "the", "skeleton."] in lines
    assert not {"counting.count", "numpy", "scipy", "pydantic"} & {*done.stderr.split()}


def test_its_schema_and_its_line_in_the_table(package):
    schema = registry.all_schemas()["stages"]["count"]
    assert schema["settings"]["properties"]["least_radius"]["unit"] == "m"
    assert (schema["step"], schema["label"], schema["writes"]) == (
        "skeleton", "Count the Nodes", ["count.txt"])
    assert "| `limber count BRANCH_FOLDER` | Count the nodes of the skeleton. |" in (
        registry.stage_table().splitlines())


def test_its_line_in_a_job_file(package, tmp_path):
    """It is checked, and becomes a command line and what a cluster gets."""
    Branch.create(tmp_path / "a.branch")
    jobs = tmp_path / "jobs.toml"
    jobs.write_text('[[job]]\nfolders = ["*.branch"]\n[[job.stage]]\nrun = "count"\n'
                    'least_radius = "4 mm"\n')
    (branch,) = read_jobs(jobs).branches
    (task,) = branch.tasks
    assert task.label == "count" and task.least_radius == 0.004
    assert commands(branch)[0].startswith("limber count --least-radius 0.004 ")
    assert type(task).checked(task.stated()) == task
    jobs.write_text(jobs.read_text().replace("4 mm", "4 kg"))
    with pytest.raises(InputError, match=r"line 5: least_radius: .*It must be in m"):
        read_jobs(jobs)


def test_its_place_in_the_add_on(package, tmp_path, monkeypatch):
    """Its step, button and settings come from the schema that LIMBER_STAGES names."""
    addon = ModuleType("addon_without_bpy")
    addon.__path__ = [str(ROOT / "addon")]
    monkeypatch.setitem(sys.modules, addon.__name__, addon)
    (tmp_path / "stages.json").write_text(json.dumps(registry.all_schemas()))
    monkeypatch.setenv("LIMBER_STAGES", str(tmp_path / "stages.json"))
    steps = importlib.import_module("addon_without_bpy.steps")
    for name in ("stages", "steps"):
        monkeypatch.delitem(sys.modules, f"addon_without_bpy.{name}")
    skeleton = next(step for step in steps.STEPS if step.name == "skeleton")
    assert [view.stage for view in skeleton.others] == ["skeleton", "count"]
    count = steps.stages()["count"]
    assert count.label == "Count the Nodes"
    assert [field.label for field in count.groups()["counting"]] == ["Least radius [m]"]
    assert count.arguments({"branch_folder": "a.branch", "least_radius": 0.004}) == [
        "count", "--least-radius", "0.004", "--", "a.branch"]


def test_a_class_that_is_registered(monkeypatch):
    """Without a package: in this process, and only once under one name."""
    class Nothing(Stage):
        """Nothing.

        More.
        """

        about = About("nothing", 3)

    monkeypatch.setattr(registry, "_registered", [])
    try:
        registry.register(Nothing)
        assert next(iter(registry.stage_summaries().items())) == ("nothing", "Nothing.")
        assert registry.stage_class("nothing") is Nothing
        Nothing.about = About("mesh", 3)
        registry._stages.cache_clear()
        with pytest.raises(InputError, match="Two modules make a stage mesh"):
            registry.stage_summaries()
    finally:
        registry._registered.clear()
        registry._stages.cache_clear()


@pytest.mark.parametrize("content", [None, '"""Nothing."""\n'])
def test_a_package_that_is_half_there_is_named(package, content):
    (package / "counting" / "count.py").unlink()
    if content is not None:
        (package / "counting" / "count.py").write_text(content)
    with pytest.raises(InputError, match=r"stage count should be in counting\.count"):
        registry.stage_summaries()
