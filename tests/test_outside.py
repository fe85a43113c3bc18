"""What another package brings by its entry points is in schema, command line, Python, batch, report
and add-on as what is Limber's own (docs: howto/extend.md)."""

import importlib
import json
import subprocess
import sys
from types import ModuleType

import numpy as np
import pytest
from tests.stages.test_registry import parsed, sample
from tests.subjects.outside import ROOT, forget, install

import limber
from limber.batch.job_file import read_jobs
from limber.batch.scheduler_scripts import commands
from limber.cli import main
from limber.core.errors import InputError
from limber.geometry.generated import generate_branch
from limber.geometry.io.clouds import CLOUDS
from limber.geometry.io.formats import suffixes_of
from limber.mechanics.materials import laws
from limber.planning.settings import PlanSpec
from limber.stages import registry
from limber.stages.stage import About, Stage
from limber.store import Branch

JOBS = """out = "results"
[[job]]
scans = ["*.foo"]
[[job.stage]]
run = "reconstruct"
radii = "even"
[[job.stage]]
run = "count"
least_radius = "4 mm"
[[job.stage]]
run = "simulate"
kind = "static"
material = "spruce"
move = ["5 mm", 0, 0]
[[job.stage]]
run = "export"
output = "{scan}.nodes"
[[job.stage]]
run = "report"
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    monkeypatch.setattr(laws, "_registered", {})
    yield install(tmp_path / "site", monkeypatch)
    forget()


@pytest.fixture
def jobs(package, tmp_path):
    """A job file for a scan in the package's format, with all that it brings."""
    points = generate_branch(1, length=0.3, fork_count=0).cloud.points
    (tmp_path / "twig.foo").write_bytes(b"dots" + np.asarray(points, "<f8").tobytes())
    (tmp_path / "jobs.toml").write_text(JOBS)
    return tmp_path / "jobs.toml"


def test_each_is_in_the_schema(package):
    """A stage whole, with its line in the table; the names of others among the choices."""
    stages = registry.all_schemas()["stages"]
    assert stages["count"]["settings"]["properties"]["least_radius"]["unit"] == "m"
    assert [stages["count"][key] for key in ("step", "label", "writes")] == [
        "skeleton", "Count the Nodes", ["count.txt"]]
    assert "| `limber count BRANCH_FOLDER` | Count the nodes of the skeleton. |" in (
        registry.stage_table().splitlines())
    for stage, field, name in (("reconstruct", "radii", "even"),
                               ("simulate", "material", "spruce")):
        assert name in stages[stage]["settings"]["properties"][field]["enum"]
    assert "line" in PlanSpec.model_json_schema()["properties"]["engine"]["enum"]
    with pytest.raises(InputError, match="has the name 'spruce'"):
        laws.material_named("pine")


def test_a_format_that_is_broken_stops_nothing(package):
    with pytest.warns(UserWarning, match="NOTHING could not register a format of a point cloud"):
        assert ".foo" in suffixes_of(CLOUDS.readers())


def test_each_is_a_command_or_an_option(package):
    """In its place in the help, for which neither it nor a numerical package is loaded."""
    done = subprocess.run(
        [sys.executable, "-c", "import sys; from limber.cli.main import call; call(['--help']); "
         "print(*sys.modules, file=sys.stderr)"], capture_output=True, text=True, check=True)
    lines = [line.split() for line in done.stdout.splitlines() if line.startswith("  ")]
    names = [words[0] for words in lines if words]
    assert names.index("skeleton") < names.index("count") < names.index("mesh")
    assert ["count", "Count", "the", "nodes", "of", "the", "skeleton."] in lines
    assert not {"outside.count", "numpy", "scipy", "pydantic"} & {*done.stderr.split()}
    stage = sample("count")
    assert parsed("count", [str(stage.branch_folder), "--force"]) == stage
    assert parsed("reconstruct", ["a.foo", "-o", "a.branch", "--radii", "even"]).radii == "even"
    assert parsed("simulate", ["a.branch", "--material", "spruce"]).material == "spruce"


def test_each_is_in_a_job_file(jobs):
    """It is checked, and becomes a command line and what a cluster gets."""
    (branch,) = read_jobs(jobs).branches
    task = branch.tasks[1]
    assert task.label == "count" and task.least_radius == 0.004
    assert commands(branch)[1].startswith("limber count --least-radius 0.004 ")
    assert type(task).checked(task.stated()) == task
    for wrong, words in (("4 kg", "line 9: count least_radius: it must be in m or cm"),
                         ("odd", "line 9: count least_radius")):
        jobs.write_text(JOBS.replace("4 mm", wrong))
        with pytest.raises(InputError, match=words):
            read_jobs(jobs)
    jobs.write_text(JOBS.replace('"even"', '"odd"'))
    with pytest.raises(InputError, match=r"line 6: reconstruct radii: .*even"):
        read_jobs(jobs)


@pytest.mark.slow
def test_a_batch_runs_all_and_the_report_shows_them(jobs, capsys):
    """In processes of their own; Python then has the typed result, and the command keeps it."""
    assert main.call(["batch", str(jobs), "--workers", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["done"] == 1
    folder = jobs.parent / "results" / "twig.branch"
    branch = Branch.open(folder)
    count = limber.open(folder).results["count"].node_count
    assert np.loadtxt(jobs.parent / "results" / "twig.nodes").shape == (count, 3)
    assert (folder / "count.txt").read_text() == str(count)
    assert branch.manifest.stages["count"].settings == {"least_radius": 0.004}
    assert branch.manifest.stages["reconstruct"].result["radius_max_m"] == pytest.approx(0.006)
    assert branch.manifest.stages["simulate"].settings["material"] == "spruce"
    page = (folder / "report.html").read_text()
    assert f"It has {count} nodes." in page and ">Counted</h2>" in page
    assert main.call(["count", str(folder), "--least-radius", "0.007", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["node_count"] == 0


def test_its_stage_is_in_the_add_on(package, tmp_path, monkeypatch):
    """Its step, button and settings come from the schema that LIMBER_STAGES names."""
    addon = ModuleType("addon_without_bpy")
    addon.__path__ = [str(ROOT / "addon")]
    monkeypatch.setitem(sys.modules, addon.__name__, addon)
    (tmp_path / "stages.json").write_text(json.dumps(registry.all_schemas()))
    monkeypatch.setenv("LIMBER_STAGES", str(tmp_path / "stages.json"))
    steps = importlib.import_module("addon_without_bpy.jobs.steps")
    for name in ("stages", "steps"):
        monkeypatch.delitem(sys.modules, f"addon_without_bpy.jobs.{name}")
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
    (package / "outside" / "count.py").unlink()
    if content is not None:
        (package / "outside" / "count.py").write_text(content)
    with pytest.raises(InputError, match=r"stage count should be in outside\.count"):
        registry.stage_summaries()
