"""What an error's text offers becomes options of the stage with values."""

import json
from pathlib import Path

import pytest

from limber.cli.main import call
from limber.core.errors import InputError
from limber.stages.error_suggestions import offers, position_in
from limber.stages.registry import stage_schema


@pytest.mark.parametrize(("stage", "text", "wanted"), [
    ("reconstruct", "Crop it (--crop-low, --crop-high). Or use the larger plant (--plants "
     "largest), or join them (--plants joined). Again: --plants largest.",
     [{"option": "plants", "value": "largest"}, {"option": "plants", "value": "joined"}]),
    ("reconstruct", "accept the axes as they are (--unexplained 1).",
     [{"option": "unexplained", "value": 1.0}]),
    ("reconstruct", "--plants everything, --no-such thing, `limber cache --clear`", []),
    ("energy", "Switch weight off (--no-gravity) or sample more: --samples 200.",
     [{"option": "gravity", "value": False}, {"option": "samples", "value": 200}]),
    ("reconstruct", "State it: --root 1.5 -2 3e-1 (probability 0.6), or --root 1 2. Or --root "
     "auto.", [{"option": "root", "value": [1.5, -2.0, 0.3]}, {"option": "root", "value": "auto"}]),
    ("plan", "Choose a goal (--goal).", [])])
def test_options_with_a_value_are_offered(stage, text, wanted):
    """In the text's order, each once; not what the stage does not know, nor what has no value."""
    found = offers(stage_schema(stage), text)
    assert found == wanted
    assert [type(one["value"]) for one in found] == [type(one["value"]) for one in wanted]


def test_an_error_says_where_it_is():
    """As three plain numbers, of any array; without one, it has no place."""
    assert InputError("Two plants.").place is None
    assert InputError("Two plants.").at(iter((1, 2.5, 3))).place == (1.0, 2.5, 3.0)


@pytest.mark.parametrize(("stage", "text", "wanted"), [
    ("plan", "The branch is 3 mm inside post at (0.1, -0.2, 3e-1) m.", [0.1, -0.2, 0.3]),
    ("load", "A point at [ 0.1  0.2 12. ] m is too far.", [0.1, 0.2, 12.0]),
    ("plan", "Flange at (0.1, 0.2, 0.3) m in the robot's base frame.", None),
    ("plan", "It is (0.1, 0.2) m wide and weighs (1, 2, 3) kg.", None),
    ("execute", "The path leaves the workspace at (0.1, 0.2, 0.3) m.", None),
    ("reconstruct", "Faces cross, one of them at (0.1, 0.2, 0.3) m.", None)])
def test_a_position_in_the_text_is_the_place(stage, text, wanted):
    """In metres of the branch's frame alone: not of the robot, nor of the scan's file."""
    assert position_in(stage_schema(stage), text) == wanted


@pytest.mark.slow
def test_the_place_is_in_the_result(capsys):
    """A cut beside the branch: the last line says where it was asked for. Slow: loads a branch."""
    example = Path(__file__).parents[2] / "blend_files" / "bending_branch"
    assert call(["load", str(example), "--cut", "9", "8", "7", "--json"]) == 2
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["place"] == [9.0, 8.0, 7.0], told["error"]
