"""An error of the worker in the panel: a short sentence, a button for each choice, a mark."""

import ast
import importlib
import json
import re
import sys
from pathlib import Path

import pytest
from tests.addon.test_panels import Layout, _draw_step

WORKER = Path(__file__).parents[2] / "worker" / "limber"


def part(name):
    return importlib.import_module(f"limber_addon.{name}")


TOLD = {"status": "failed", "code": "InputError", "place": [1200.0, 2000.0, 300.0],
        "choices": [{"option": "plants", "value": "largest"}, {"option": "unknown", "value": 1}],
        "error": "The scan contains two plants. A branch belongs to one plant. Crop the scan "
                 "(--crop-low, --crop-high). Or use the larger plant (--plants largest)."}


@pytest.fixture()
def failing(bpy, registered, whole_texts, tmp_path, monkeypatch):
    """A scan in millimetres, far from the origin, that a worker refuses until it is told to take
    the larger plant; what it was called with is written down."""
    scan = tmp_path / "twig.xyz"
    scan.write_text("1000 2000 0\n1000 2000 100\n1000 2000 500\n")
    calls = tmp_path / "calls"
    script = tmp_path / "worker.py"
    script.write_text(
        "import json, sys\n"
        f"open({str(calls)!r}, 'a').write(json.dumps(sys.argv[1:]) + '\\n')\n"
        "good = '--plants' in sys.argv\n"
        f"print(json.dumps({{'status': 'done', 'seconds': 0.1}} if good else {TOLD!r}))\n"
        "sys.exit(0 if good else 2)\n")
    monkeypatch.setattr(part("preferences"), "worker_command",
                        lambda: [sys.executable, str(script)])
    bpy.context.scene.limber.reconstruct.unit = "mm"
    bpy.ops.limber.import_cloud(filepath=str(scan))
    return calls


@pytest.mark.slow
def test_a_choice_is_a_button_that_runs_the_step_again(bpy, failing):
    """Refused; its sentence, its mark and its button are there; pressed, the step is done."""
    with pytest.raises(RuntimeError, match=r"two plants.*Plants: largest"):
        bpy.ops.limber.reconstruct()
    scene, stage = bpy.context.scene, part("stages").stages()["reconstruct"]
    mark = part("trouble_mark").of(scene, stage)
    bpy.context.view_layer.update()
    cloud = next(thing for thing in scene.objects if "limber_scan_sha256" in thing)
    local = [1200.0, 2000.0, 300.0]
    offset = cloud.get("limber_map_offset", (0.0, 0.0, 0.0))
    assert list(mark.matrix_world.translation) == pytest.approx(
        [0.001 * (a - b) for a, b in zip(local, offset, strict=True)], abs=1e-5)
    drawn = _draw_step(bpy, "skeleton")
    labels = drawn.names("label")
    assert "The scan contains two plants." in labels
    assert "The place is marked in the view" in labels and "Why, and what to do" in labels
    assert not [text for text in labels if "--" in text]
    assert ("operator", "limber.take_choice", "Plants: largest") in drawn.calls
    assert drawn.names("operator").count("limber.take_choice") == 1, "what is unknown has no button"
    assert {"crop_low", "crop_high"} <= set(drawn.names("prop")), "settings without a value"
    result = bpy.ops.limber.take_choice(stage="reconstruct", option="plants", value='"largest"')
    assert result == {"FINISHED"}
    assert "--plants" in json.loads(failing.read_text().splitlines()[-1])
    assert part("trouble_mark").of(scene, stage) is None
    assert "Why, and what to do" not in _draw_step(bpy, "skeleton").names("label")


@pytest.mark.parametrize(("stage", "text", "wanted"), [
    ("reconstruct", "Crop it (--crop-low, --crop-high).", "Crop it (Crop low, Crop high)."),
    ("reconstruct", "Join them (--plants joined).", "Join them (Plants: joined)."),
    ("plan", "Run `limber energy b.branch` first.", "Run Sample the Energy first."),
    ("plan", "Or use --goal with a tip.", "Or use Goal with a tip."),
    ("energy", "Switch it off (--no-gravity).", "Switch it off (Gravity: off)."),
    ("energy", "`limber cache --clear` and --such-a-thing 3", None)])
def test_options_are_told_by_their_titles(addon, stage, text, wanted):
    """As the panels call them; what no panel has stays as it is."""
    words = part("plain_words").plain(text, part("stages").stages()[stage])
    assert words == (text if wanted is None else wanted)


def test_settings_without_a_value_are_shown(addon):
    """Each once, in the text's order: not those with a value, switches, or what no panel keeps."""
    stage = part("stages").stages()["reconstruct"]
    found = part("plain_words").settings_in(
        "Crop it (--crop-low, --crop-high), join (--plants joined), give --root or --crop-low; "
        "--no-force, --output, --such-a-thing.", stage)
    assert [field.name for field in found] == ["crop_low", "crop_high", "root"]


def test_a_step_that_an_error_names_is_a_button(bpy, registered, whole_texts):
    """Each once; not one that would replace the branch or move a robot, nor what is no step."""
    layout, steps = Layout(), part("panels.steps")
    steps.draw_error(layout, bpy.context, part("stages").stages()["plan"], {"error": (
        "There is no field. Run `limber energy b.branch` first, then `limber energy` with `limber "
        "reconstruct`, `limber execute` or `limber doctor`.")})
    assert layout.names("operator") == ["limber.energy"]


@pytest.mark.slow
def test_every_error_of_a_stage_is_told_without_the_command_line(addon):
    """Each text that the worker raises, as far as a step of the tab can meet it. Slow: reads all of
    the worker's source."""
    plain = part("plain_words").plain
    known = {"`limber cache --clear`": "no panel has the cache",
             "`limber scene`": "what runs Blender by itself",
             "--no-reduced": "of `limber session`, which the grab runs without it"}
    left = {}
    for room in ("geometry", "mechanics", "reduced", "recordings", "perception", "estimation",
                 "planning", "store", "session", "results", "stages"):
        for path in (WORKER / room).rglob("*.py"):
            raised = (node.exc for node in ast.walk(ast.parse(path.read_text()))
                      if isinstance(node, ast.Raise) and node.exc is not None)
            for text in (each.value for one in raised for each in ast.walk(one)
                         if isinstance(each, ast.Constant) and isinstance(each.value, str)):
                for hit in re.findall(r"--[a-z][a-z-]+|`limber [^`]*`", plain(text)):
                    left.setdefault(hit, path.name)
    assert not {hit: name for hit, name in left.items() if hit not in known}


def test_the_root_that_an_error_asks_for_is_set_by_a_button_or_the_cursor(bpy, failing):
    """The button sets the place, or the word; the cursor gives the file's coordinates."""
    stages, properties = part("stages").stages(), part("properties")
    stage = stages["reconstruct"]
    group = properties.group_of(bpy.context.scene, stage)

    def root():
        return properties.values_of(group, stage, {"root"})["root"]
    assert root() is None
    for value in ([1.0, -2.0, 300.0], "auto"):
        with pytest.raises(RuntimeError, match="two plants"):
            bpy.ops.limber.take_choice(stage="reconstruct", option="root", value=json.dumps(value))
        assert root() == (value if value == "auto" else tuple(value))
        typed = json.loads(failing.read_text().splitlines()[-1])
        given = typed[typed.index("--root") + 1:]
        assert given[0] == "auto" if value == "auto" else [*map(float, given[:3])] == value
    assert part("plain_words").choice_title(stage, "root", [1.0, -2.0, 0.5]) == "Root: 1 -2 0.5"
    bpy.context.view_layer.update()
    bpy.context.scene.cursor.location = (1.0, 2.0, 0.5)
    cloud = next(thing for thing in bpy.context.scene.objects if "limber_scan_sha256" in thing)
    offset = cloud.get("limber_map_offset", (0.0, 0.0, 0.0))
    assert bpy.ops.limber.from_cursor(stage="reconstruct", field="root") == {"FINISHED"}
    assert root() == pytest.approx(
        [1000 * place + off for place, off in zip((1, 2, 0.5), offset, strict=True)], rel=1e-5)
    properties.take_over(group, stage, {"root": "auto"})
    assert root() == "auto" and not properties.differs(group, stage, {"root": "auto"})
    assert properties.differs(group, stage, {"root": None})
