"""`limber demo`: what it hands to the stages, and its end when one of them fails."""

import pytest

from limber import cli
from limber.commands import demo
from limber.errors import NoPathError


@pytest.fixture
def stages(monkeypatch):
    """Stages that do nothing: their arguments by name; `fail` names one that finds no way."""
    seen: dict[str, list[str]] = {"fail": []}
    results = {"estimate": {"young_pa": [1e9], "young_interval_pa": [[9e8, 1.1e9]]},
               "virtual-pull": {"young_true_pa": [1e9]},
               "plan": {"baseline": {}, "plan": {}, "energy_saved_percent": 1.0,
                        "length_added_percent": 2.0}}

    def run(arguments, _progress):
        seen[arguments[0]] = arguments
        if arguments[0] in seen["fail"]:
            raise NoPathError("There is no path.", "Walls.", "Move the goal.")
        return results.get(arguments[0], {})
    monkeypatch.setattr(demo, "run_stage", run)
    return seen


def test_what_is_known_of_a_scan_reaches_the_stages(stages, tmp_path) -> None:
    """Up, root, crop and goal, negative numbers too."""
    scan = tmp_path / "scan.xyz"
    scan.write_text("0 0 0\n")
    assert cli.call(["demo", str(scan), "-o", str(tmp_path / "out"), "--up", "0", "-1", "0",
                     "--root", "1", "2", "3", "--crop", "-1", "0", "-2", "4", "5", "6",
                     "--goal", "0.1", "0.2", "0.3"]) == 0
    told = " ".join(stages["reconstruct"])
    for part in ("--up 0.0 -1.0 0.0", "--root 1.0 2.0 3.0", "--crop-low -1.0 0.0 -2.0",
                 "--crop-high 4.0 5.0 6.0"):
        assert part in told
    assert " ".join(stages["plan"]).endswith("--goal 0.1 0.2 0.3")


@pytest.mark.parametrize("failing", ["plan", "estimate"])
def test_a_failure_after_the_mesh_ends_in_a_report(stages, tmp_path, failing, capsys) -> None:
    """Scene and report are made; the exit code is the failure's."""
    stages["fail"] = [failing]
    assert cli.call(["demo", "-o", str(tmp_path / "out")]) == NoPathError.exit_code
    assert "report" in stages and "scene" in stages
    told = capsys.readouterr().err
    assert "There is no path." in told and "report.html" in told


def test_a_scan_that_cannot_be_meshed_ends_at_once(stages, tmp_path) -> None:
    """Without a branch there is nothing to report."""
    stages["fail"] = ["reconstruct"]
    assert cli.call(["demo", "-o", str(tmp_path / "out")]) == NoPathError.exit_code
    assert "report" not in stages
