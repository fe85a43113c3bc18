"""`limber demo`: what it hands to the stages, and its end when one of them fails."""

import importlib.util
import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from limber.cli import main
from limber.cli.commands import demo
from limber.cli.stage_command import StageCommand
from limber.core.errors import NoPathError, Option, Text, WorkError
from limber.stages.command_line import options_of, without_foreign_options
from limber.store import Branch

OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")


@pytest.fixture
def stages(monkeypatch):
    """Stages that do nothing: their arguments by name; `fail` names one that finds no way."""
    seen: dict = {"fail": [], "pull": {"young_true_pa": [1e9]}}
    results = {"estimate": {"young_pa": [1e9], "young_interval_pa": [[9e8, 1.1e9]]},
               "virtual-pull": seen["pull"],
               "plan": {"baseline": {}, "plan": {"length_m": 0.2}, "energy_saved_percent": 1.0,
                        "length_added_percent": 2.0}}

    def run(arguments, _progress):
        seen[arguments[0]] = arguments
        seen.setdefault("order", []).append(arguments[0])
        if arguments[0] == "reconstruct":
            folder = next(Path(each) for each in arguments if each.endswith(".branch"))
            if not folder.exists():
                Branch.create(folder)
        if arguments[0] in seen["fail"]:
            raise NoPathError(Text("There is no path (", Option("max_strain", 0.01), ")."),
                              "Walls.", "Raise ", Option("max_force"), " or ",
                              Option("max_strain"), ". Or move the goal (", Option("goal"), ").")
        return results.get(arguments[0], {})
    monkeypatch.setattr(demo, "run_stage", run)
    monkeypatch.setattr(demo, "_tip_goal", lambda _branch: ["--tip-goal", 1.0, 0.0, 0.5])
    return seen


def test_what_is_known_of_a_scan_reaches_the_stages(stages, tmp_path) -> None:
    """Up, root, crop and goal, negative numbers too."""
    scan = tmp_path / "scan.xyz"
    scan.write_text("0 0 0\n")
    assert main.call(["demo", str(scan), "-o", str(tmp_path / "out"), "--up", "0", "-1", "0",
                     "--root", "1", "2", "3", "--crop", "-1", "0", "-2", "4", "5", "6",
                     "--goal", "0.1", "0.2", "0.3"]) == 0
    told = " ".join(stages["reconstruct"])
    for part in ("--up 0.0 -1.0 0.0", "--root 1.0 2.0 3.0", "--crop -1.0 0.0 -2.0 4.0 5.0 6.0"):
        assert part in told
    assert " ".join(stages["plan"]).endswith("--goal 0.1 0.2 0.3")
    assert main.call(["demo", str(scan), "-o", str(tmp_path / "other")]) == 0
    assert " ".join(stages["plan"]).endswith("--tip-goal 1.0 0.0 0.5"), "a place for the tip"


@pytest.mark.parametrize("own", [False, True])
def test_a_simulated_pull_of_ones_own_scan_is_no_truth(stages, tmp_path, own, capsys) -> None:
    """Its modulus is assumed, at the top and in the tables; that of a generated branch is true."""
    scan = tmp_path / "scan.xyz"
    scan.write_text("0 0 0\n")
    stages["pull"]["young_assumed"] = own
    assert main.call(["demo", *([str(scan)] if own else []), "-o", str(tmp_path / "out")]) == 0
    told = capsys.readouterr()
    words = told.out + told.err
    assert ("stiffness of this branch was not measured" in words) == own
    assert ("assumed E [MPa]" in words) == own and ("true E [MPa]" in words) != own
    assert ("contain the true modulus" in words) != own


def test_the_pull_has_the_errors_of_a_cell(stages, tmp_path) -> None:
    """A generated branch is pulled with a sensor for its small force, a scan's with a robot's own.
    """
    assert main.call(["demo", "-o", str(tmp_path / "out")]) == 0
    told = " ".join(stages["virtual-pull"])
    assert "sensor.toml" in told
    scan = tmp_path / "scan.xyz"
    scan.write_text("0 0 0\n")
    assert main.call(["demo", str(scan), "-o", str(tmp_path / "own")]) == 0
    told = " ".join(stages["virtual-pull"])
    assert "--cell-errors realistic" in told


def test_a_second_demo_keeps_results_and_renders_nothing_again(stages, tmp_path, capsys) -> None:
    """It says so. Once the branch has changed, its scene is made anew."""
    branch, out = Branch.create(tmp_path / "generated.branch"), tmp_path
    with branch.stage("energy") as stage:
        stage.result["sample_count"] = 1
    for name in ("scene.blend", "scene.png"):
        (out / name).write_text("made")
    assert main.call(["demo", "-o", str(out)]) == 0
    assert stages["order"].count("scene") == 1
    capsys.readouterr()
    assert main.call(["demo", "-o", str(out)]) == 0
    told = capsys.readouterr()
    assert stages["order"].count("scene") == 1 and stages["order"].count("plan") == 2
    assert "a scene and its picture" in told.err and "kept" in told.err
    assert "All results were kept from an earlier demo" in told.out
    with branch.stage("energy") as stage:
        stage.result["sample_count"] = 2
    assert main.call(["demo", "-o", str(out)]) == 0
    assert stages["order"].count("scene") == 2


def test_the_scene_comes_last_and_its_failure_is_a_warning(stages, tmp_path, capsys) -> None:
    """The report is there before it, and gets the picture after it; nothing old is shown as new."""
    out = tmp_path / "out"
    assert main.call(["demo", "-o", str(out)]) == 0
    assert stages["order"][-4:] == ["plan", "report", "scene", "report"]
    assert "--picture" in stages["report"]
    out.joinpath("scene.blend").write_text("old")
    stages["fail"], stages["order"] = ["scene"], []
    capsys.readouterr()
    assert main.call(["demo", "-o", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert stages["order"][-2:] == ["report", "scene"] and "--picture" not in stages["report"]
    assert told["report"].endswith("report.html") and told["scene"] is told["picture"] is None
    assert [one for one in told["warnings"] if "There is no scene and no picture" in one
            and "Or move the goal" in one]


def test_without_the_packages_of_the_report_all_else_is_made(stages, tmp_path, monkeypatch,
                                                             capsys) -> None:
    """It is said before the work begins, with the remedy."""
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec",
                        lambda name, *more: None if name == "jinja2" else found(name, *more))
    assert main.call(["demo", "-o", str(tmp_path / "out"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert "report" not in stages["order"] and stages["order"][-1] == "scene"
    assert told["report"] is None and "jinja2 is not installed" in told["warnings"][0]
    assert "--with report" in told["warnings"][0] or "[report]" in told["warnings"][0]


def test_a_demo_ends_with_what_was_found_and_where(stages, tmp_path, capsys) -> None:
    """Few lines; a scene that was not made is not named."""
    stages["fail"] = ["scene"]
    assert main.call(["demo", "-o", str(tmp_path / "out")]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("The gentle path is 200 mm long")
    assert any(line.startswith("report") for line in told)
    assert not any(line.startswith("scene") for line in told)
    assert told[-2].startswith("next  ") and len(told) < 8


@pytest.mark.parametrize("failing", ["plan", "estimate"])
def test_a_failure_after_the_mesh_ends_in_a_report(stages, tmp_path, failing, capsys) -> None:
    """Scene and report are made; the exit code is the failure's."""
    stages["fail"] = [failing]
    assert main.call(["demo", "-o", str(tmp_path / "out")]) == NoPathError.exit_code
    assert "report" in stages and "scene" in stages
    told = capsys.readouterr().err
    assert "There is no path." in told and "report.html" in told


def test_a_scan_that_cannot_be_meshed_ends_at_once(stages, tmp_path) -> None:
    """Without a branch there is nothing to report."""
    stages["fail"] = ["reconstruct"]
    assert main.call(["demo", "-o", str(tmp_path / "out")]) == NoPathError.exit_code
    assert "report" not in stages


def test_options_of_reconstruct_reach_it(stages, tmp_path) -> None:
    """What its refusals propose, the demo takes."""
    scan = tmp_path / "scan.xyz"
    scan.write_text("0 0 0\n")
    assert main.call(["demo", str(scan), "-o", str(tmp_path / "out"), "--plants", "largest",
                     "--unexplained", "1", "--skeleton", "own.swc", "--unit", "mm"]) == 0
    told = " ".join(stages["reconstruct"])
    for part in ("--plants largest", "--unexplained 1.0", "--skeleton own.swc", "--unit mm"):
        assert part in told
    assert "--young" not in told


def test_refusals_of_a_scan_name_only_options_that_the_demo_has() -> None:
    """All that scan and skeleton code names in its messages."""
    folder = Path(demo.__file__).parents[2] / "geometry"
    files = [*folder.glob("skeleton/**/*.py"), *folder.glob("cloud/*.py"), *folder.glob("io/*.py"),
             folder / "reconstruction.py", folder / "pruned_twigs.py"]
    named = {"--" + option.replace("_", "-") for path in files for option in re.findall(
        r'Option\("(\w+)"', path.read_text(encoding="utf-8"))}
    assert {"--plants", "--crop", "--skeleton", "--unexplained"} <= named
    assert named <= options_of(StageCommand(demo.Demo))


@pytest.mark.parametrize("failing", ["reconstruct", "plan"])
def test_what_a_stage_alone_can_take_is_not_proposed(stages, tmp_path, failing, capsys) -> None:
    """Of a stage's advice the demo keeps what its own user can follow."""
    stages["fail"] = [failing]
    assert main.call(["demo", "-o", str(tmp_path / "out")]) == NoPathError.exit_code
    told = capsys.readouterr().err
    assert "There is no path. Walls. Or move the goal (--goal)." in told
    assert f"`limber {failing}` has more options" in told
    assert {*OPTION.findall(told)} <= options_of(StageCommand(demo.Demo))


def test_sentences_and_brackets_with_other_options_are_left_out() -> None:
    """Numbers with a point and dashes within words end and name nothing."""
    text = Text("At 0.5 m (", Option("voxel", 0.1), ") well-known. Give ", Option("b_c", 1.5),
                ", or ", Option("a"), ". Or ", Option("b"), ".")
    assert without_foreign_options(text, {"--b", "--a"}) == "At 0.5 m well-known. Or --b."
    assert without_foreign_options(text, {"--b", "--a", "--b-c", "--voxel"}) == text


@pytest.mark.parametrize("in_goal", [True, False])
def test_a_demo_with_a_robot_ends_with_what_came_of_it(monkeypatch, tmp_path, capsys, in_goal):
    """Intervals, flower and force in a sentence; a picture that failed is not named."""
    result = {"branch": "loop.branch", "covered": [True, False], "flower_in_goal": in_goal,
              "force_within_share": 0.987}
    monkeypatch.setattr("limber.cli.closed_loop.loop.ClosedLoop",
                        lambda *_arguments, **_options: SimpleNamespace(run=lambda: result))
    monkeypatch.setattr("limber.cli.closed_loop.comparison.comparison", lambda _result: [])

    def run(arguments, _progress=None):
        if arguments[0] == "scene":
            raise WorkError("There is no Blender.")
        return {"report": "loop.branch/report.html"}
    monkeypatch.setattr(demo, "run_stage", run)
    assert main.call(["demo", "--robot", "-o", str(tmp_path)]) == 0
    told = capsys.readouterr()
    assert told.out.startswith("1 of 2 intervals contain the true modulus; the flower "
                               + ("was brought to its goal" if in_goal else "did not reach"))
    assert "98.7 % of it" in told.out and "report  loop.branch/report.html" in told.out
    assert "picture" not in told.out and "There is no scene and no picture" in told.err
