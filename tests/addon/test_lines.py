"""Texts in lines as wide as the sidebar."""

from types import SimpleNamespace

import pytest
from tests.addon.conftest import part


@pytest.fixture()
def lines(addon):
    return part("panels.lines")


def test_no_line_is_wider_than_there_is_room(lines):
    """Words stay whole where they fit; one that is too wide is broken; nothing is lost."""
    text = "The path /data/somebody/branches/an-apple-tree/the-scan-of-a-branch.ply is none."
    found = lines.wrapped(text, 120.0)
    assert all(lines.width(line) <= 120.0 for line in found)
    assert "".join(found).replace(" ", "") == text.replace(" ", "")
    assert found[0] == "The path"
    assert lines.wrapped("A few words", 400.0) == ("A few words",)
    assert lines.wrapped("", 400.0) == ()


def test_a_narrow_sidebar_makes_more_lines(bpy, lines):
    """A sidebar that is dragged wider has longer lines; without one it has its usual width."""
    region = type("Region", (), {"type": "UI", "width": 600})()
    wide = type("Context", (), {"region": region, "preferences": bpy.context.preferences})()
    assert lines.room(wide) > 2 * lines.room(bpy.context) > 0
    text = "A text of some length that has to be put into several lines"
    assert len(lines.wrapped(text, lines.room(wide))) < len(
        lines.wrapped(text, lines.room(bpy.context)))


def test_a_changed_font_size_changes_the_lines(bpy, lines):
    """The user makes the interface's font larger while Blender runs."""
    text = "A text of some length that has to be put into several lines"
    before = lines.wrapped(text, 200.0)
    bpy.context.preferences.ui_styles[0].widget.points *= 2
    after = lines.wrapped(text, 200.0)
    assert len(after) > len(before)
    assert all(lines.width(line) <= 200.0 for line in after)


def test_what_does_not_fit_beside_stands_above(bpy, lines):
    """A title too wide, or a text too wide for its field, leaves the field its own line."""
    assert lines.has_room_beside(bpy.context, "Poisson", "")
    assert not lines.has_room_beside(bpy.context, "Interpolated radius", "")
    assert not lines.has_room_beside(bpy.context, "Young", "6e+07, 4e+07, 2.5e+07, 1.5e+07")


@pytest.mark.parametrize(("value", "text"), [
    (60000000.0, "6e+07"), (0.1, "0.1"), (900.0, "900.0"), (123456.0, "123456.0"), (3, "3")])
def test_numbers_are_short(addon, value, text):
    """As short as their single precision allows, and the same number again."""
    number_text = part("jobs.stages").number_text
    assert number_text(value) == text
    assert float(text) == value


def test_an_error_beside_the_mouse_fits_the_screen(lines):
    """In lines in a window; a script gets the worker's text as it is."""
    operator = part("jobs.worker_operator").WorkerOperator
    text = "The scan contains two plants, and a branch belongs to one plant alone. " * 5
    context, told = SimpleNamespace(window=SimpleNamespace(width=1280)), []
    for is_beside in (True, False):
        pressed = SimpleNamespace(_is_beside=is_beside,
                                  report=lambda _kind, words: told.append(words))
        operator._complain(pressed, context, text)
    wrapped, whole = told
    assert whole == text
    assert len(wrapped.splitlines()) > 1 and wrapped.split() == text.split()
    assert max(map(lines.width, wrapped.splitlines())) < 1280
