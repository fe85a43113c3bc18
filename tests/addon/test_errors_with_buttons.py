"""An error of the worker in the panel: a short sentence, a button for each choice, a mark."""

import json
import re
import sys

import pytest
from tests.addon.catalogue import told
from tests.addon.conftest import part
from tests.addon.test_panels import Layout, _draw_step

from limber.core.errors import Command, InputError, Option, Text

ERROR = InputError(
    "The scan contains two plants.", "A branch belongs to one plant.", "Crop the scan (",
    Option("crop"), "). Or use the larger plant (",
    Option("plants", "largest"), ").").at([1200.0, 2000.0, 300.0])
TOLD = json.loads(json.dumps(ERROR.as_json()))
TOLD["remedies"].append(Option("unknown", 1).as_json())


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
    scene, stage = bpy.context.scene, part("jobs.stages").stages()["reconstruct"]
    mark = part("jobs.trouble_mark").of(scene, stage)
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
    assert "crop" in drawn.names("prop"), "settings without a value"
    result = bpy.ops.limber.take_choice(stage="reconstruct", option="plants", value='"largest"')
    assert result == {"FINISHED"}
    assert "--plants" in json.loads(failing.read_text().splitlines()[-1])
    assert part("jobs.trouble_mark").of(scene, stage) is None
    assert "Why, and what to do" not in _draw_step(bpy, "skeleton").names("label")


@pytest.mark.parametrize(("stage", "named", "wanted"), [
    ("reconstruct", Option("crop"), "Crop"),
    ("reconstruct", Option("plants", "joined"), "Plants: joined"),
    ("reconstruct", Option("root", (1.0, -2.0, 0.5)), "Root: 1 -2 0.5"),
    ("plan", Command("energy", "b.branch"), "Sample the Energy"),
    ("simulate", Option("gravity", False), "Gravity: off"),
    ("energy", Command("cache", Option("clear", True)), "`limber cache --clear`"),
    ("energy", Option("such_a_thing", 3), "--such-a-thing 3")])
def test_options_are_told_by_their_titles(addon, stage, named, wanted):
    """As the panels call them; what no panel has stays as it is. In warnings too."""
    text, words = Text("Or (", named, ")."), part("jobs.plain_words")
    outcome = {"warning_parts": [{"text": text, "parts": json.loads(json.dumps(text.as_json()))}]}
    described = part("jobs.stages").stages()[stage]
    assert words.warning_text(outcome, text, described) == f"Or ({wanted})."
    assert words.warning_text(outcome, "Another.") == "Another."
    assert words.error_texts({"error": "No result."}) == ["No result."]


def test_settings_without_a_value_are_shown(bpy, registered, whole_texts):
    """Each once, in the text's order: not those with a value, switches, or what no panel keeps."""
    layout, steps = Layout(), part("panels.steps")
    stage = part("jobs.stages").stages()["reconstruct"]
    error = InputError("Two plants.", "", *map(Option, (
        "crop", "camera_at", "root", "crop", "force", "output", "such_a_thing")),
                       Option("plants", "joined"))
    steps.draw_error(layout, bpy.context, stage, error.as_json())
    assert [name for name in layout.names("prop") if name in stage.fields] == [
        "crop", "camera_at", "root"]


def test_a_step_that_an_error_names_is_a_button(bpy, registered, whole_texts):
    """Each once; not one that would replace the branch or move a robot, nor what is no step."""
    layout, steps = Layout(), part("panels.steps")
    error = InputError("There is no field.", "", *map(Command, (
        "energy", "reconstruct", "execute", "doctor")), Command("energy", Option("samples")))
    steps.draw_error(layout, bpy.context, part("jobs.stages").stages()["plan"], error.as_json())
    assert layout.names("operator") == ["limber.energy"]


@pytest.mark.slow
def test_every_error_of_a_stage_is_told_without_the_command_line(addon):
    """Each text that the worker raises, as far as a step of the tab can meet it. Slow: reads all of
    the worker's source."""
    words, stages = part("jobs.plain_words"), part("jobs.stages").stages()
    known = {"`limber cache --clear`": "no panel has the cache",
             "`limber scene`": "what runs Blender by itself",
             "`limber 0.1234 0.1234`": "what makes a file that is missing",
             "--reduced": "of `limber session`, which the grab runs with it"}
    left = {hit for stage, parts in told()
            for hit in re.findall(r"--[a-z][a-z-]+|`limber [^`]*`", " ".join(
                words.error_texts({"parts": [parts]}, stages[stage])))}
    assert not left - {*known}


def test_the_root_that_an_error_asks_for_is_set_by_a_button_or_the_cursor(bpy, failing):
    """The button sets the place, or the word; the cursor gives the file's coordinates."""
    stages, properties = part("jobs.stages").stages(), part("properties")
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
