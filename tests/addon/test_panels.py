"""The panels draw what they should; a fake layout writes it down."""

import importlib
import json
import shutil
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from tests.addon.conftest import part

from limber.stages.pulls.virtual_pull import VirtualPull
from limber.store import Branch

pytestmark = pytest.mark.usefixtures("whole_texts")

EXAMPLE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


class Layout:
    """Stands for UILayout: keeps every call, and every text that a user would read.

    Parts that open are open. What Blender's own layout would not take is an error here too.
    """

    def __init__(self, calls=None):
        self.calls = [] if calls is None else calls

    def row(self, heading="", **_):
        if heading:
            self.calls.append(("label", heading, None))
        return Layout(self.calls)

    column = row

    def split(self, factor, **_):
        assert 0 < factor < 1
        return Layout(self.calls)

    def operator_menu_enum(self, name, choice, text):
        assert choice in getattr(bpy_module().ops.limber, name.split(".")[1]).get_rna_type(
            ).properties
        self.calls.append(("menu", name, text))

    def menu(self, name, text, icon="NONE"):
        assert hasattr(bpy_module().types, name) and icon in ICONS
        self.calls.append(("menu", name, text))

    def panel(self, name, default_closed=False):
        self.calls.append(("panel", name, None))
        return Layout(self.calls), Layout(self.calls)

    def operator(self, name, icon="NONE", **options):
        group, action = name.split(".")
        assert icon in ICONS
        if group == "limber":
            assert action in dir(bpy_module().ops.limber), name
        self.calls.append(("operator", name, options.get("text")))
        return SimpleNamespace()

    def prop(self, owner, name, **_):
        assert hasattr(owner, name), name
        self.calls.append(("prop", name, None))

    def label(self, text="", icon="NONE", **_):
        assert icon in ICONS
        self.calls.append(("label", text, icon))

    def progress(self, factor, text, **_):
        self.calls.append(("progress", factor, text))

    def names(self, kind):
        return [call[1] for call in self.calls if call[0] == kind]


def bpy_module():
    return sys.modules["bpy"]


class _Icons:
    def __contains__(self, name):
        function = bpy_module().types.UILayout.bl_rna.functions["prop"]
        return name in function.parameters["icon"].enum_items


ICONS = _Icons()


def _draw(panel, context):
    layout = Layout()
    panel.draw(SimpleNamespace(layout=layout), context)
    return layout


@pytest.fixture()
def panels(worker_here):
    def panel(name):
        module = importlib.import_module(
            "limber_addon.plan.play_panel" if name == "play" else f"limber_addon.panels.{name}")
        return getattr(module, f"LIMBER_PT_{name}")
    return panel


STEPS = ("scan", "skeleton", "mesh", "material", "pulls", "estimate", "plan", "robot", "report")


def _step(bpy, name):
    return getattr(bpy.types, f"LIMBER_PT_{name}")


def _draw_step(bpy, name):
    panel = _step(bpy, name)
    drawn = Layout()
    panel.draw(SimpleNamespace(layout=drawn, step=panel.step), bpy.context)
    return drawn


def test_every_panel_is_in_the_tab(bpy, panels):
    """All steps stand in the sidebar tab Limber, in order; each can be drawn."""
    kinds = [panels("job"), panels("result"), *(_step(bpy, name) for name in STEPS), panels("play")]
    assert {kind.bl_category for kind in kinds} == {"Limber"}
    orders = [kind.bl_order for kind in kinds]
    assert orders == sorted(set(orders))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "first", "more"), [
    ("scan", "limber.import_cloud", ("limber.crop_scan",)), ("skeleton", "limber.reconstruct", ()),
    ("mesh", "limber.reconstruct", ()), ("material", "limber.color_by", ()),
    ("pulls", "limber.import_pull", ()), ("estimate", "limber.estimate", ()),
    ("plan", "limber.place_goal", ("limber.plan",)),
    ("robot", "limber.execute", ("limber.arm",)),
    ("report", "limber.report", ("limber.open_report",))])
def test_a_step_has_one_primary_button_and_its_settings(bpy, panels, name, first, more):
    """Its stages' buttons in order, and every setting of the schema; the common ones at once."""
    stages = part("jobs.stages").stages()
    drawn = _draw_step(bpy, name)
    shown = [call for call in drawn.names("operator") if call not in (
        "limber.from_cursor", "limber.from_object")]
    others = [f"limber.{stage.name.replace('-', '_')}" for stage in stages.values()
              if stage.step == name]
    assert shown == [first, *more, *(button for button in others if button not in (first, *more))]
    step = _step(bpy, name).step
    common = drawn.names("prop")
    bpy.context.scene.limber.show_expert = True
    whole = _draw_step(bpy, name).names("prop")
    for view in (step.view, *step.others):
        for field in stages[view.stage].own_fields if view.groups is None else ():
            assert field.name in (whole if field.is_expert else common), (view.stage, field.name)
    assert not {"arm", "confirm"} & set(whole), "that it may move is typed each time"


def test_the_expert_settings_are_shown_on_demand(bpy, panels):
    """Few need them: a switch shows them."""
    assert "twig_radius" not in _draw_step(bpy, "skeleton").names("prop")
    bpy.context.scene.limber.show_expert = True
    assert "twig_radius" in _draw_step(bpy, "skeleton").names("prop")


@pytest.mark.slow
def test_a_step_says_how_far_it_is(bpy, panels, branch_folder, small):
    """Not run, done, out of date by its input or its settings, failed; and what comes next."""
    module = part("panels.steps")
    scene = bpy.context.scene

    def state(name):
        return module.state_of(scene, name)[0]
    assert state("virtual-pull") is module.StepState.NOT_RUN
    VirtualPull(branch_folder=branch_folder, name="pull-1", young=small.young, frames=12,
                seed=4).run()
    scene.limber.branch_folder = str(branch_folder)
    # The panels still have defaults, the pull was made with others.
    assert state("virtual-pull") is module.StepState.CHANGED
    opening = bpy.ops.limber.open_result(directory=str(branch_folder))
    assert opening == {"FINISHED"}
    assert scene.limber.virtual_pull.seed == 4, "the branch's own settings"
    assert state("virtual-pull") is module.StepState.DONE
    assert module.step_state(scene, _step(bpy, "pulls").step) is module.StepState.DONE
    texts = _draw_step(bpy, "pulls").names("label")
    assert any(text.endswith(" N") for text in texts), texts
    scene.limber.virtual_pull.frames = 20
    assert state("virtual-pull") is module.StepState.CHANGED
    scene.limber.virtual_pull.frames = 12
    with Branch.open(branch_folder).stage("reconstruct") as stage:
        stage.path("skeleton.swc").write_text(
            (branch_folder / "skeleton.swc").read_text() + "# edited\n")
    assert state("virtual-pull") is module.StepState.STALE
    properties = part("properties")
    stages = part("jobs.stages").stages()
    properties.keep_outcome(scene, stages["virtual-pull"], str(branch_folder),
                            {"status": "failed", "error": "It broke.", "warnings": ["It bent."]})
    assert state("virtual-pull") is module.StepState.FAILED
    texts = _draw_step(bpy, "pulls").names("label")
    assert "It broke." in texts and "It bent." in texts
    scene.limber.virtual_pull.name = "another"
    properties.keep_outcome(scene, stages["virtual-pull"], str(branch_folder), {})
    assert state("virtual-pull") is module.StepState.NOT_RUN


def test_an_empty_scene(bpy, panels):
    """At first a result can be opened; playing and the job are not there."""
    context = bpy.context
    assert _draw(panels("result"), context).names("operator") == ["limber.open_result"]
    assert not panels("play").poll(context)
    assert not panels("job").poll(context)
    assert "Young: assumed, not measured" in _draw_step(bpy, "material").names("label")


@pytest.mark.slow
def test_an_opened_result(bpy, panels, beam):
    """With a result: its legend with units, play, and the energy of the frame."""
    bpy.ops.limber.open_result(directory=str(beam.folder))
    texts = _draw(panels("result"), bpy.context).names("label")
    assert any("tetrahedra" in text for text in texts)
    assert any(text.endswith("MPa (assumed)") for text in texts)
    assert panels("play").poll(bpy.context)
    bpy.context.scene.frame_set(6)
    drawn = _draw(panels("play"), bpy.context)
    assert drawn.names("operator") == ["limber.play", "limber.retime", "limber.export_motion",
                                       "limber.turntable", "limber.set_up_picture"]
    assert drawn.names("label") == ["Energy 10 mJ"]


@pytest.mark.slow
def test_paths_and_moduli_stand_side_by_side(bpy, panels, tmp_path):
    """The example: E with its interval, both paths with their energy, what is proven; graphs."""
    shutil.copytree(EXAMPLE, tmp_path / "example")
    bpy.ops.limber.open_result(directory=str(tmp_path / "example"))
    plan, estimate = _draw_step(bpy, "plan"), _draw_step(bpy, "estimate")
    # It ran elsewhere: its warning is in the folder.
    assert any("A gap of 32 mm was bridged" in text
               for text in _draw_step(bpy, "skeleton").names("label"))
    result = json.loads((EXAMPLE / "plans" / "to-goal.json").read_text())
    texts = plan.names("label")
    for key in ("plan", "baseline"):
        assert f"{result[key]['energy_sum_nmm']:.3g}" in texts
        assert f"{1e3 * result[key]['length_m']:.3g}" in texts
    gap = result["certificate"]["gap_percent"]
    assert f"Proven on the field: at most {gap:.1f} % above the minimum" in texts
    estimated = json.loads((EXAMPLE / "estimate.json").read_text())
    low, high = estimated["young_interval_pa"][0]
    for value in (low, high):
        assert f"{1e-6 * value:.3g}" in estimate.names("label")
    assert f"1:  {1e-6 * estimated['young_pa'][0]:.3g}" in estimate.names("label")
    assert "limber.graph" in plan.names("operator") and "limber.graph" in estimate.names("operator")


@pytest.mark.parametrize(("over", "stress", "icon", "warning"), [
    (False, 0.5, "CHECKMARK", ""), (True, 0.5, "BLANK1", "Strain 1.2 x the strength (green wood)"),
    (False, 1.8, "BLANK1", "May break: stress 1.8 times the strength")])
def test_a_path_that_breaks_the_wood_is_never_ticked(bpy, worker_here, over, stress, icon, warning):
    """What is proven of its cost stands without a tick, above what is wrong with it."""
    comparing = part("panels.comparing")
    layout, path = Layout(), {"length_m": 0.1, "peak_strain": 0.007}
    comparing.draw_paths(layout, bpy.context, {
        "plan": path, "baseline": path, "certificate": {"gap_percent": 1.0},
        "strength": {"peak_strain": 0.0072, "median_strain": 0.006, "over": over,
                     "source": "green wood"}}, None, stress)
    assert {"Gentle", "Shortest"} <= set(layout.names("label"))
    proven = next(call for call in layout.calls if str(call[1]).startswith("Proven"))
    assert proven[2] == icon
    errors = [call[1] for call in layout.calls if call[0] == "label" and call[-1] == "ERROR"]
    assert errors == ([warning] if warning else [])


@pytest.mark.slow
def test_without_a_client_for_robots_there_is_no_robot(bpy, panels, whole_texts, monkeypatch):
    """As in the zips: neither the step nor Record, and one line that says why."""
    preferences = part("preferences")
    preferences._looked.clear()

    def shown():
        return _step(bpy, "robot").poll(bpy.context), [
            text for name in STEPS if _step(bpy, name).poll(bpy.context)
            for text in _draw_step(bpy, name).names("label")]
    is_there, before = shown()
    assert is_there and "Record a Pull" in before and not any("ur-rtde" in text for text in before)
    worker = part("jobs.worker")
    monkeypatch.setattr(preferences, "worker_command", worker.bundled_command)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, found=importlib.util.find_spec: (
        None if name == "rtde_control" else found(name)))
    preferences._looked.clear()
    is_there, after = shown()
    assert not is_there and "Record a Pull" not in after
    layout = Layout()
    panel = _step(bpy, "report")
    panel.draw_header(SimpleNamespace(layout=layout, step=panel.step), bpy.context)
    assert layout.names("label") == ["8"], "numbers without a gap"
    assert sum("ur-rtde" in text for text in after) == 1


@pytest.mark.slow
def test_where_to_start(bpy, panels, beam):
    """An empty scene offers the example, a scan, a folder; with a branch it makes way."""
    drawn = _draw(panels("start"), bpy.context)
    assert drawn.names("operator") == ["limber.open_example", "limber.import_cloud",
                                       "limber.open_result", "limber.workspace"]
    assert panels("start").poll(bpy.context)
    bpy.ops.limber.open_result(directory=str(beam.folder))
    assert not panels("start").poll(bpy.context)


def test_jobs_that_wait_are_listed(bpy, panels):
    """What runs with its time and numbers, then what waits, each with its own cross."""
    jobs = part("jobs.jobs")
    job = jobs.add("Estimating", [sys.executable, "-c", "import time; time.sleep(30)"])
    jobs.add("Planning", [sys.executable, "-c", ""])
    jobs.add("Reporting", [sys.executable, "-c", ""])
    job.numbers = {"best_m2": 2.5e-5, "young_mpa": "70 30", "young_factor": "1.1 1e+15"}
    drawn = _draw(panels("job"), bpy.context)
    texts = drawn.names("label")
    assert ["Then: Planning", "Then: Reporting"] == [text for text in texts if "Then" in text]
    assert "Lowest loss 2.5e-05 m²" in texts and {
        "E 70 (63.6 to 77), 30 (not yet known) MPa"} <= set(texts)
    assert any(text.endswith("so far") for text in texts)
    assert bpy.ops.limber.cancel_job(waiting=1) == {"FINISHED"}
    assert [waiting.title for waiting in jobs.waiting()] == ["Planning"]
    job._heard_at -= 100
    texts = _draw(panels("job"), bpy.context).names("label")
    assert any("has not responded" in text for text in texts)


def test_a_running_and_a_failed_job(bpy, panels):
    """While the worker works: a bar and a cancel button; after a failure: why."""
    jobs = part("jobs.jobs")
    job = jobs.start("Reconstructing", [sys.executable, "-c", (
        "import sys, time; print('{\"progress\": 0.25, \"message\": \"radii\"}', flush=True); "
        "time.sleep(30)")])
    end = time.monotonic() + 10
    while job.fraction == 0 and time.monotonic() < end:
        job.poll()
        time.sleep(0.02)
    assert panels("job").poll(bpy.context)
    drawn = _draw(panels("job"), bpy.context)
    assert ("progress", 0.25, "25 %") in drawn.calls
    assert drawn.names("operator") == ["limber.cancel_job"]
    assert not bpy.ops.limber.reconstruct.poll(), "one job at a time"
    assert bpy.ops.limber.cancel_job() == {"FINISHED"}
    job.wait()
    assert not panels("job").poll(bpy.context)
    jobs.start("Reconstructing", [sys.executable, "-c", "raise SystemExit('no points')"]).wait()
    drawn = _draw(panels("job"), bpy.context)
    assert "no points" in " ".join(drawn.names("label"))
    assert drawn.names("operator") == ["limber.cancel_job"]
    assert bpy.ops.limber.cancel_job() == {"FINISHED"}
    assert not panels("job").poll(bpy.context), "dismissed"


def test_no_worker_is_said_in_the_panel(bpy, panels, monkeypatch):
    """The step that needs the worker says so where it is missing."""
    monkeypatch.setenv("LIMBER_PYTHON", "/nowhere/python")
    drawn = _draw(panels("result"), bpy.context)
    assert "No worker was found." in drawn.names("label")
    assert "preferences.addon_show" in drawn.names("operator")


def test_names_are_chosen_from_what_the_branch_has(bpy, panels, tmp_path):
    """Plans, motions and pulls are listed; all of them while one is chosen, else what fits."""
    properties = part("properties")
    stages = part("jobs.stages").stages()
    scene = bpy.context.scene
    scene.limber.branch_folder = str(EXAMPLE)

    def listed(stage, field, typed=""):
        stage = stages[stage]
        search = properties._search(properties._pattern(stage, stage.fields[field]))
        return search(properties.group_of(scene, stage), bpy.context, typed)
    for stage, field in (("scene", "plan"), ("scene", "motion"), ("execute", "name"),
                         ("suggest-pull", "plan")):
        assert "to-goal" in listed(stage, field), (stage, field)
    for stage, field in (("estimate", "pull"), ("export-pull", "name")):
        assert listed(stage, field) == ["pull-1"]
    assert listed("scene", "motion", "to-goal") == listed("scene", "motion")
    assert listed("scene", "plan", "nothing") == []
    assert properties._pattern(stages["plan"], stages["plan"].fields["name"]) == ""
    scene.limber.branch_folder = str(tmp_path)
    assert listed("scene", "plan") == []


def test_every_choice_has_a_tooltip(bpy, panels):
    """Of every setting of every stage."""
    stages = part("jobs.stages").stages()
    for stage in stages.values():
        group = getattr(bpy.context.scene.limber, stage.name.replace("-", "_"))
        for field in stage.fields.values():
            assert field.description, (stage.name, field.name)
            for item in getattr(group.bl_rna.properties[field.name], "enum_items", ()):
                assert item.description, (stage.name, field.name, item.identifier)


def _change(content, scene, *, without=(), rewritten="", ended=(), queued="", folder="",
            **settings):
    """Bring folder, settings, outcomes and queue into a state."""
    for kind in ("stages", "files"):
        content[kind] = {name: entry for name, entry in content[kind].items()
                         if not name.startswith(tuple(without) or "-")}
    if rewritten:
        content["stages"][content["files"][rewritten]["stage"]]["finished"] = "2100-01-01"
        content["files"][rewritten]["sha256"] = "0" * 64
    for name, value in settings.items():
        group, name = name.split("_", 1)
        group = getattr(scene.limber, group)
        setattr(group, f"use_{name}", True)
        setattr(group, name, value)
    if ended:
        name, status = ended
        stage = part("jobs.stages").stages()[name]
        part("properties").keep_outcome(
            scene, stage, scene.limber.branch_folder, {"status": status, "error": "It broke."})
    if queued:
        jobs = part("jobs.jobs")
        jobs._waiting.append(jobs.Job(queued, [], folder or scene.limber.branch_folder))


@pytest.mark.slow
def test_the_next_step_is_a_button_in_thirty_states(bpy, panels, tmp_path):
    """From the folder, the settings, the last outcomes and the queue: not an estimate without
    pulls; the plan, which samples first."""
    path, found = tmp_path / "example" / "branch.json", []
    table = json.loads(Path(__file__).with_name("next_steps.json").read_text())
    shutil.copytree(EXAMPLE, path.parent)
    whole = path.read_text()
    for changes, _ in table:
        path.write_text(whole)
        bpy.ops.limber.open_result(directory=str(path.parent))
        _change(content := json.loads(whole), bpy.context.scene, **changes)
        path.write_text(json.dumps(content))
        found.append(next((name.removeprefix("limber.") for kind, name, *title in
                           _draw(panels("result"), bpy.context).calls
                           if kind == "operator" and str(title[:1]).startswith("['Next: ")), None))
        part("jobs.jobs")._waiting.clear()
        for group in ("estimate", "plan"):
            getattr(bpy.context.scene.limber, group).outcome = ""
    assert list(enumerate(found)) == list(enumerate(name for _, name in table))
    menu = Layout()
    bpy.types.LIMBER_MT_colours.draw(SimpleNamespace(layout=menu), bpy.context)
    assert len(menu.names("operator")) == 8


@pytest.mark.slow
def test_a_scan_is_reconstructed_next(bpy, registered, tmp_path):
    """Imported, it has no branch yet: that comes next. Nothing does where neither is there, or
    where it failed."""
    steps = part("panels.steps")
    scene = bpy.context.scene
    assert steps.next_stage(scene) is None
    (tmp_path / "twig.xyz").write_text("0 0 0\n0 0 0.1\n0 0 0.2\n")
    bpy.ops.limber.import_cloud(filepath=str(tmp_path / "twig.xyz"))
    assert steps.next_stage(scene).name == "reconstruct"
    with pytest.raises(RuntimeError, match="points"):
        bpy.ops.limber.reconstruct()
    assert steps.next_stage(scene) is None
