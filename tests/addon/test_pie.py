"""The pie menu, and the tooltips of choices."""

from types import SimpleNamespace

import pytest
from tests.addon.conftest import part
from tests.addon.test_panels import Layout


def drawn(bpy):
    layout = Layout()
    layout.menu_pie = lambda: layout
    bpy.types.LIMBER_MT_pie.draw(SimpleNamespace(layout=layout), bpy.context)
    return layout


def test_without_a_branch_it_begins(bpy, registered):
    """The example and a scan; no more than eight, which a pie has room for."""
    layout = drawn(bpy)
    assert {"limber.open_example", "limber.import_cloud", "limber.grab"} <= set(
        layout.names("operator"))
    assert len(layout.calls) <= 8


@pytest.mark.slow
def test_with_a_branch_it_goes_on(bpy, worker_here, bare_beam):
    """The next step, in the branch that is the current one; the colours."""
    bpy.ops.limber.open_result(directory=str(bare_beam.folder))
    layout = drawn(bpy)
    following = part("panels.steps").next_stage(bpy.context.scene)
    assert ("operator", f"limber.{following.name.replace('-', '_')}",
            f"Next: {following.label}") in layout.calls
    assert ("menu", "LIMBER_MT_colours", "Colour By") in layout.calls
    assert len(layout.calls) <= 8


def test_a_choice_has_a_tooltip_of_its_own(bpy, registered):
    """What the description says of it, where it says so choice by choice."""
    stages = part("jobs.stages").stages()
    leaves = stages["reconstruct"].fields["leaves"]
    told = {choice: leaves.about(choice) for choice in leaves.choices}
    assert told["keep"] == "treat all points as wood."
    assert told["cut"].startswith("remove them") and "keep" not in told["cut"]
    unit = stages["reconstruct"].fields["unit"]
    assert unit.about("mm") == unit.description
    items = bpy.context.scene.limber.reconstruct.bl_rna.properties["leaves"].enum_items
    assert {item.identifier: item.description for item in items} == told
