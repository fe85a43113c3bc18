"""The Python interface: every verb, its result, and that it is the same as the command."""

import doctest
import importlib.util
import inspect
import io
import json
import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from tests.golden.references import small_parts
from tests.subjects.commands import answer

import limber
from benchmarks.robot_cells import cell_file, standing_at
from limber.api import branch
from limber.core.errors import BranchFolderError, InputError, MissingDependencyError, WorkError
from limber.core.progress import LineSink
from limber.geometry.io.clouds import read_cloud
from limber.stages import result
from limber.store import Branch as Folder

EXAMPLE = Path(__file__).parents[1] / "blend_files" / "bending_branch"
PROCESS = ("command", "status", "seconds", "error", "warning_parts")
RESULTS = [getattr(limber, name) for name in limber.__all__
           if isinstance(getattr(limber, name), type)
           and issubclass(getattr(limber, name), limber.Result)]


def told_by_command(*arguments: object) -> dict:
    """The JSON result of a command line, without what is of its run."""
    code, told = answer(*arguments)
    assert code == 0, told
    return {name: value for name, value in told.items() if name not in PROCESS}


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """A branch with the results of all stages up to a plan."""
    return limber.open(shutil.copytree(EXAMPLE, tmp_path_factory.mktemp("example") / "a.branch"))


@pytest.fixture
def own(tmp_path):
    """The same to write to."""
    return limber.open(shutil.copytree(EXAMPLE, tmp_path / "a.branch"))


@pytest.fixture
def small_stages():
    """Stages have few frames, samples and cells."""
    with small_parts():
        yield


def test_importing_it_loads_nothing_heavy():
    """`import limber` and the names of what it has cost no numerical package."""
    code = ("import limber, sys; assert 'plan' not in dir(limber) and 'Plan' in dir(limber); "
            "print([n for n in ('numpy', 'scipy', 'pydantic', 'rich') "
            "if n in sys.modules])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", limber.__all__)
def test_public_names_are_explained(name):
    """Each has a docstring, its public members as well, and a result says units."""
    thing = getattr(limber, name)
    assert inspect.getdoc(thing)
    if inspect.isclass(thing):
        for member, value in vars(thing).items():
            if not member.startswith("_") and (callable(value) or isinstance(
                    value, property | classmethod)):
                assert inspect.getdoc(getattr(thing, member)), member


@pytest.mark.parametrize("name", [*(name for name in limber.__all__ if name != "__version__"), *(
    f"Branch.{name}" for name, value in vars(limber.Branch).items()
    if not name.startswith("_") and (callable(value) or isinstance(value, property)))])
def test_public_names_have_an_example(name):
    """Each shows a call; `test_the_docstrings_examples` runs them."""
    thing, _, member = name.partition(".")
    told = inspect.getdoc(getattr(getattr(limber, thing), member) if member
                          else getattr(limber, thing))
    assert doctest.DocTestParser().get_examples(told)


DIMENSIONLESS = ("ratio", "strain", "fraction", "factor", "positions of the control points",
                 "root mean square", "likewise", "dimensionless")
"""A quantity without a unit says one of these."""


@pytest.mark.parametrize("kind", RESULTS)
def test_results_say_units(kind):
    """Each number or array of a result has its unit in square brackets, or is dimensionless."""
    for name, field in kind.model_fields.items():
        assert f"    {name}: " in kind.__doc__
        if any(word in str(field.annotation) for word in ("ndarray", "float")):
            meaning = field.description
            assert "[" in meaning or any(word in meaning.lower() for word in DIMENSIONLESS), (
                f"{kind.__name__}.{name}: {meaning}")


def test_names_for_programs_are_those_for_type_checkers():
    """What a type checker sees of the package is what it has."""
    text = Path(limber.__file__).read_text(encoding="utf-8")
    seen = {line.split(" import ")[1].split(" as ")[0]: line.split()[1].removeprefix("limber.")
            for line in text.splitlines() if line.startswith("    from limber.")}
    assert seen == limber._PLACES


@pytest.mark.slow
@pytest.mark.usefixtures("small_stages")
@pytest.mark.filterwarnings("ignore:A gap")
def test_the_docstrings_examples(own, tmp_path, monkeypatch):
    """They run as they stand, in a folder with a scan and a branch."""
    monkeypatch.chdir(tmp_path)
    limber.generate("scan", length=0.3, fork_count=0, seed=1)
    counts = [doctest.testmod(
        module, extraglobs={"limber": limber},
        optionflags=doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL)
        for module in (branch, *{
            sys.modules[kind.__module__] for kind in RESULTS})]
    assert sum(count.attempted for count in counts) >= 20
    assert not sum(count.failed for count in counts)


@pytest.mark.parametrize("key", ["estimate", "energy", "plan:to-goal", "pull:pull-1",
                                 "reconstruct"])
def test_results_print_and_are_frozen(example, key):
    """One short line, a table for a notebook, and nothing that can be changed."""
    result = example.results[key]
    assert len(repr(result)) < 300 and "\n" not in repr(result)
    assert repr(result).startswith(type(result).__name__ + "(")
    markup = HTMLParser()
    markup.feed(result._repr_html_())
    markup.close()
    assert result._repr_html_().count("<tr>") == len(result._shown())
    with pytest.raises(ValueError, match="frozen"):
        result.warnings = ()
    with pytest.raises(TypeError):
        result.values["x"] = 1
    for value in vars(result).values():
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0


@pytest.mark.parametrize("key, columns", [
    ("estimate", 7), ("energy", 7), ("plan:to-goal", 12), ("pull:pull-1", 13)])
def test_results_become_tables_and_pictures(example, key, columns):
    """Columns of one length with units in their names; a figure that no window keeps open."""
    import matplotlib.pyplot as plt

    result, before = example.results[key], plt.get_backend()
    plt.close("all")
    table = result.table()
    assert len(table) == columns and len({len(column) for column in table.values()}) == 1
    assert all(column.ndim == 1 and column.dtype == float for column in table.values())
    assert result.plot()._repr_png_().startswith(b"\x89PNG")
    assert not plt.get_fignums() and plt.get_backend() == before


def test_a_table_is_one_of_pandas(example):
    """pandas takes it as it is."""
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(example.results["estimate"].table())
    assert frame["young_pa"].tolist() == example.results["estimate"].young.tolist()


def test_a_picture_says_what_it_needs(example, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(MissingDependencyError, match=r"(--with |pip install .*\[)report"):
        example.results["estimate"].plot()


def test_the_estimate_is_that_of_the_file(example):
    """Shapes and values are those of estimate.json, in Pa."""
    told = json.loads((example.folder / "estimate.json").read_text())
    found = example.results["estimate"]
    assert found.young.tolist() == told["young_pa"]
    assert found.interval.tolist() == told["young_interval_pa"]
    assert found.control_points.shape == (4, 3) and found.converged is True
    assert (found.interval[:, 0] < found.young).all()


def test_the_plan_has_its_certificate(example):
    """The bound is below the cost, and the gap says how far."""
    plan = example.results["plan:to-goal"]
    assert 0 < plan.bound <= plan.cost
    assert plan.gap == pytest.approx(100 * (plan.cost / plan.bound - 1))
    assert plan.path.shape == (len(plan.times), 6) and plan.forces.shape == (len(plan.times), 3)
    assert plan.plot_along().axes
    with pytest.raises(InputError, match="no strains along the branch"):
        plan.model_copy(update={"damage": None}).plot_damage()


@pytest.mark.slow
def test_the_energy_field_answers_between_its_samples(example):
    """At a sample it has about the sample's energy; force and energy have a row a point."""
    field = example.results["energy"]
    far = field.energies.argmax()
    assert field.energy(field.positions[[far]]) == pytest.approx(field.energies[[far]], rel=0.02)
    assert field.force(field.positions[:3]).shape == (3, 3)


def test_a_branch_tells_what_it_holds(example):
    """It prints and draws; mesh and skeleton are those of the folder."""
    assert "896" in repr(example) and "plan:to-goal" in repr(example)
    assert "<table>" in example._repr_html_()
    assert example.mesh.tet_count == 896 and example.mesh.cell_data["young"].max() > 1e6
    assert example.skeleton.radius.max() < 0.05
    assert example.plot().axes
    assert repr(example.pulls) == "<pull-1>" and len(example.results) == 6
    with pytest.raises(KeyError, match="known: pull-1"):
        example.pulls["pull-2"]


@pytest.mark.parametrize("wrong, told", [
    (lambda branch: branch.plan(gaol=(0, 0, 1)), "plan has no 'gaol'. Did you mean goal?"),
    (lambda branch: branch.estimate(methods="x"), "Did you mean method?"),
    (lambda branch: branch.plan(max_force=-1), "max_force -1: it must be greater than 0"),
    (lambda branch: branch.simulate(move=(1, 2)), "move [1, 2]"),
    (lambda branch: branch.load(), "Give wind, snow, fruit or cut"),
    (lambda branch: branch.session(modes="point"), "Did you mean mode?"),
    (lambda branch: branch.session(mode="held"), "mode 'held'"),
    (lambda branch: branch.estimate(follow=True), 'branch.run("estimate", follow=True)'),
    (lambda branch: branch.run("plann"), "There is no stage 'plann'. Did you mean plan"),
    (lambda branch: branch.run("target"), "limber.settings('target') lists what it takes."),
    (lambda branch: branch.run("mesh"), "Call limber.mesh."),
    (lambda branch: branch.export(branch.folder / "a.doc"), "suffix"),
    (lambda branch: limber.reconstruct(np.zeros((4, 2)), "x"), "shape (4, 2)"),
    (lambda branch: limber.reconstruct(branch.folder, "x"), "for each of its files"),
    (lambda branch: limber.settings("plann"), "Did you mean plan"),
])
def test_what_is_wrong_is_said_in_a_python_users_words(example, wrong, told):
    """The nearest known name is proposed; no message names an option of the command line."""
    with pytest.raises(InputError, match=re.escape(told)) as refused:
        wrong(example)
    assert "--" not in str(refused.value)


def test_a_command_in_a_message_stays_whole(tmp_path):
    """An option becomes a keyword argument, a command that is to be typed stays one."""
    from limber.api.branch import in_python_words
    from limber.core.errors import Command, Option, Text

    with pytest.raises(WorkError) as told, in_python_words():
        raise WorkError(Text(Option("gravity", False), " is given."),
                        Text(Option("max_force"), " is not."),
                        "Run ", Command("x", Option("force", True)), ".")
    assert str(told.value) == "gravity=False is given. max_force is not. Run `limber x --force`."


def test_verbs_in_two_threads_give_the_script_back():
    """It is hidden until the last of them has ended, in whatever order they do."""
    from limber.api.branch import script_run_once

    script = sys.modules["__main__"]
    first, second = script_run_once(), script_run_once()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert not hasattr(sys.modules["__main__"], "__file__")
    second.__exit__(None, None, None)
    assert sys.modules["__main__"] is script


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(BranchFolderError, match="no folder"):
        limber.open(tmp_path / "none.branch")


def test_settings_are_listed():
    """All of a verb's and no more; required ones are marked; a verb goes by its command's name."""
    known = limber.settings("energy_field")
    assert set(known) == {"samples", "field_error", "deflection", "seed", "force"}
    assert known["samples"].default == 225 and "  samples = 225: Number" in repr(known)
    assert known._repr_html_().count("<tr>") == len(known) + 1
    assert limber.settings("add_pull")["source"].default == "required"
    assert list(limber.settings("energy")) == list(known)


def test_a_line_shows_progress_where_a_bar_cannot():
    """It is written over itself, and gone at the end."""
    stream = io.StringIO()
    with LineSink("plan", stream, interval_seconds=0.0) as sink:
        sink(0.25, "searching", {})
        sink(0.251, "searching", {"cost": 1.0})
        sink(0.5, "far", {})
    first, second, last, end = stream.getvalue().split("\r")[1:]
    assert first == "plan  25 % searching"
    assert second == "plan  50 % far" + 6 * " "
    assert (last, end) == (14 * " ", "")


@pytest.mark.slow
def test_quiet_shows_nothing(own, capfd):
    """With it not even a notebook gets a line; warnings and the result are the same."""
    settings = {"move": (0.005, 0.0, 0.0), "kind": "static", "duration": 0.05, "hold": 0.0}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "ipykernel", sys)
        quiet = own.simulate(**settings, quiet=True)
        assert capfd.readouterr().err == ""
        shown = own.simulate(**settings, name="shown")
        assert "simulate" in capfd.readouterr().err
    assert shown.energies.tolist() == quiet.energies.tolist()


def test_warnings_are_pythons_at_the_users_line(branch_folder, tmp_path):
    """They name the line that called the verb, and stand in the result."""
    with pytest.warns(UserWarning, match="No swing has been fitted") as seen:
        written = limber.open(branch_folder).export(tmp_path / "a.urdf")
    assert seen[0].filename == __file__
    assert written.warnings == (str(seen[0].message),)
    assert written.path.is_file() and "a.urdf" in repr(written)


@pytest.mark.slow
def test_simulations_and_loads(own):
    """Force and energy of a pull, sag and strain of snow; arrays may stand for tuples."""
    bent = own.simulate(move=np.array([0.01, 0.0, 0.0]), kind="static", duration=0.1, hold=0.0)
    assert bent.positions.shape[0] == len(bent.times) == len(bent.table()["strain"])
    assert bent.energies[-1] == bent.values["energy_j"] > 0
    assert bent.plot().axes and "converged" in bent._shown()
    snow = own.load(snow=2.0, name="winter")
    stored = own.results["load:winter"]
    assert snow.sag == stored.sag > 0 and snow.frequencies.tolist() == stored.frequencies.tolist()
    assert snow.sag_interval[0] < snow.sag < snow.sag_interval[1]
    assert snow.strain_over_limit == pytest.approx(snow.greatest_strain / 0.01)
    assert 0 < snow.table()["strain"].max() <= snow.greatest_strain
    assert snow.plot().axes and "sag" in repr(snow)


@pytest.mark.slow
def test_a_simulation_that_fails_keeps_its_frames(own):
    """The error is the stage's; what the branch reached can be looked at."""
    with pytest.raises(WorkError, match="could not follow"):
        own.simulate(move=(0.0, 0.0, -5.0), kind="static", duration=0.05, hold=0.0)
    assert own.results["simulate"].converged is False


def test_a_stage_without_a_verb_runs(branch_folder):
    """Its result is what its command prints."""
    branch = limber.open(branch_folder)
    branch.run("target", name="flower", at=branch.skeleton.nodes[-1])
    assert "target:flower" in branch.results


@pytest.mark.slow
def test_a_session_follows(branch_folder):
    """The session is that of the command."""
    with limber.open(branch_folder).session(mode="point", reduced=False) as session:
        assert session.hello["event"] == "hello" and session.alive
    assert not session.alive


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:A gap")
def test_arrays_give_the_branch_of_their_file(tmp_path):
    """Points as an array, as columns and as a file become the same tetrahedra."""
    scan = limber.generate(tmp_path / "scan", length=0.3, fork_count=0, seed=1)
    assert repr(scan).startswith("Generated(points 3,049, length 0.300 m")
    cloud = read_cloud(scan.cloud)
    known = limber.reconstruct(scan.cloud, tmp_path / "file.branch", mesh_spacing=4)
    columns = dict(zip("xyz", cloud.points.T, strict=True)) | cloud.attributes
    for number, given in enumerate((cloud.points, columns)):
        made = limber.reconstruct(given, tmp_path / f"{number}.branch", mesh_spacing=4)
        assert made.mesh.nodes.tolist() == known.mesh.nodes.tolist()
        assert made.mesh.tets.tolist() == known.mesh.tets.tolist()
    # The same columns are the same scan: nothing is computed again.
    before = (made.folder / "mesh.vtu").stat().st_mtime_ns
    limber.reconstruct(columns, made.folder, mesh_spacing=4)
    assert (made.folder / "mesh.vtu").stat().st_mtime_ns == before


@pytest.mark.slow
def test_surfaces_become_branches(tmp_path):
    """A surface's file gives a branch with its mesh."""
    import trimesh

    path = tmp_path / "rod.stl"
    trimesh.creation.cylinder(0.01, 0.2, sections=8).export(path)
    assert limber.mesh(path, tmp_path / "rod.branch").mesh.tet_count > 100


@pytest.mark.slow
@pytest.mark.usefixtures("small_stages")
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_verbs_are_the_commands(own, tmp_path):
    """A command with the same settings finds all done, and prints what the verb returned."""
    fit = {"fractions": (0.2, 0.4, 0.6, 0.8), "quick": True}
    done = {}
    for command, verb, *options in (
            ("estimate", lambda: own.estimate(**fit), "--fractions",
             "0.2,0.4,0.6,0.8", "--quick"),
            ("energy", lambda: own.energy_field(samples=30), "--samples", 30),
            ("plan", lambda: own.plan(name="p"), "--name", "p"),
            ("virtual-pull", lambda: own.virtual_pull(name="q", frames=4, seed=5), "--name", "q",
             "--frames", 4, "--seed", 5),
            ("load", lambda: own.load(snow=1.0), "--snow", 1),
            ("simulate", lambda: own.simulate(pull="q"), "--pull", "q"),
            ("report", own.report)):
        done[command] = verb()
        entries = dict(Folder.read(own.folder).manifest.stages)
        told = told_by_command(command, own.folder, *options)
        assert told | {"warnings": ()} == dict(done[command].values) | {"warnings": ()}, command
        assert Folder.read(own.folder).manifest.stages == entries, command
    assert done["report"].path.stat().st_size > 10_000
    cell = standing_at(Folder.read(own.folder), "127.0.0.1", fraction=0.667)
    dry = own.execute(cell_file(cell, tmp_path), name="p", unwatched=True)
    assert not dry.armed and dry.peak_force is None and "armed no" in repr(dry)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="needs bpy")
def test_a_scene_is_written(own, tmp_path):
    """The verb names its file."""
    written = own.scene(tmp_path / "a.blend")
    assert written.path.stat().st_size > 10_000 and written.values["scene"] == str(written.path)


@pytest.mark.slow
def test_a_recording_comes_in_and_goes_on(branch_folder, tmp_path):
    """A pull that was written out comes back as another of the same force."""
    branch = limber.open(branch_folder)
    branch.run("export-pull", name="pull-1", mcap=tmp_path / "one.mcap")
    again = branch.add_pull(tmp_path / "one.mcap", "again")
    assert np.nanmax(np.abs(again.forces)) == pytest.approx(
        np.nanmax(np.abs(branch.pulls["pull-1"].forces)), rel=1e-6)


@pytest.mark.slow
def test_a_script_needs_no_guard(example, tmp_path):
    """Processes that a stage starts do not run the script again."""
    folder = shutil.copytree(example.folder, tmp_path / "a.branch")
    script = tmp_path / "script.py"
    script.write_text("import limber\nprint('begun')\n"
                      f"branch = limber.open({str(folder)!r})\n"
                      "print(branch.energy_field(samples=30))\n")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False,
                          timeout=250, env=os.environ | {"LIMBER_CORES": "2"})
    assert done.returncode == 0, done.stderr
    begun, result = done.stdout.splitlines()
    assert begun == "begun" and result.startswith("EnergyField(samples 3")


def test_results_are_all_of_one_make():
    """Every public result prints, and has no field that may be set."""
    assert len(RESULTS) == 10
    for kind in RESULTS:
        assert kind.model_config["frozen"] and result.Result in kind.__mro__
