"""The panels draw what they should; a fake layout writes it down."""

import importlib
import sys
import time
from types import SimpleNamespace

import pytest


class Layout:
    """Stands for UILayout: keeps every call, and every text that a user would read."""

    def __init__(self, calls=None):
        self.calls = [] if calls is None else calls

    def row(self, **_):
        return Layout(self.calls)

    column = row

    def operator(self, name, **options):
        self.calls.append(("operator", name, options.get("text")))
        return SimpleNamespace()

    def prop(self, owner, name, **_):
        assert hasattr(owner, name)
        self.calls.append(("prop", name, None))

    def label(self, text="", **_):
        self.calls.append(("label", text, None))

    def progress(self, factor, text, **_):
        self.calls.append(("progress", factor, text))

    def names(self, kind):
        return [call[1] for call in self.calls if call[0] == kind]


def _draw(panel, context):
    layout = Layout()
    panel.draw(SimpleNamespace(layout=layout), context)
    return layout


@pytest.fixture()
def panels(registered):
    def panel(name):
        module = importlib.import_module(f"limber_addon.panels.{name}")
        return getattr(module, f"LIMBER_PT_{name}")
    return panel


def test_every_panel_is_in_the_tab(bpy, panels):
    """All steps stand in the sidebar tab Limber, in order."""
    names = ("job", "import_cloud", "reconstruct", "result", "play")
    assert {panels(name).bl_category for name in names} == {"Limber"}
    assert [panels(name).bl_order for name in names] == [0, 1, 2, 3, 4]


def test_an_empty_scene(bpy, panels):
    """At first: import, reconstruct and open are offered, playing and the job are not."""
    context = bpy.context
    assert _draw(panels("import_cloud"), context).names("operator") == ["limber.import_cloud"]
    assert _draw(panels("reconstruct"), context).names("operator") == ["limber.reconstruct"]
    assert _draw(panels("result"), context).names("operator") == ["limber.open_result"]
    assert not panels("play").poll(context)
    assert not panels("job").poll(context)


def test_an_opened_result(bpy, panels, beam):
    """With a result: its legend with units, play, and the energy of the frame."""
    bpy.ops.limber.open_result(directory=str(beam.folder))
    texts = _draw(panels("result"), bpy.context).names("label")
    assert any("tetrahedra" in text for text in texts)
    assert any(text.endswith("MPa") for text in texts)
    assert panels("play").poll(bpy.context)
    bpy.context.scene.frame_set(6)
    drawn = _draw(panels("play"), bpy.context)
    assert drawn.names("operator") == ["limber.play"]
    assert drawn.names("label") == ["Energy 10 mJ"]


def test_a_running_and_a_failed_job(bpy, panels):
    """While the worker works: a bar and a cancel button; after a failure: why."""
    jobs = importlib.import_module("limber_addon.jobs")
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
    assert "no points" in " ".join(_draw(panels("job"), bpy.context).names("label"))


def test_no_worker_is_said_in_the_panel(bpy, panels, monkeypatch):
    """The step that needs the worker says so where it is missing."""
    monkeypatch.setenv("LIMBER_PYTHON", "/nowhere/python")
    texts = _draw(panels("reconstruct"), bpy.context).names("label")
    assert "No worker was found." in texts
