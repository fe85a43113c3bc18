"""In a real Blender's window: no text of the tab is cut, which is as wide in any window at first.

Blender cuts a text that is too wide and puts an ellipsis. Here its font is one that has only that
letter, a block; all others are taken from the fonts that it falls back on. A block in the picture
is a text that was cut.
"""

import json

import numpy as np
import pytest
from fontTools.fontBuilder import FontBuilder
from fontTools.pens.ttGlyphPen import TTGlyphPen
from PIL import Image
from scipy import ndimage
from tests.addon.catalogue import told
from tests.addon.window import driven, require_screen

pytestmark = [pytest.mark.real_blender, pytest.mark.slow]

SIZE = (640, 2600)
"""Twice as wide as the sidebar; high enough for all settings of a panel."""
BLOCK = (12, 6)
"""Height and width of what a block has at least, and no letter or icon [pixels]."""


def write_font(path) -> None:
    """Write the font whose only letter is the ellipsis."""
    pen = TTGlyphPen(None)
    pen.moveTo((0, -200))
    for corner in ((0, 1000), (800, 1000), (800, -200)):
        pen.lineTo(corner)
    pen.closePath()
    font = FontBuilder(1000, isTTF=True)
    font.setupGlyphOrder([".notdef", "ellipsis"])
    font.setupCharacterMap({0x2026: "ellipsis"})
    font.setupGlyf({".notdef": TTGlyphPen(None).glyph(), "ellipsis": pen.glyph()})
    font.setupHorizontalMetrics({".notdef": (500, 0), "ellipsis": (800, 0)})
    font.setupHorizontalHeader(ascent=1000, descent=-200)
    font.setupNameTable({"familyName": "Cut", "styleName": "Regular"})
    font.setupOS2(sTypoAscender=1000, usWinAscent=1000, usWinDescent=200)
    font.setupPost()
    font.save(path)


def cuts(path, sidebar) -> list[tuple[int, int]]:
    """Return where in a picture of the sidebar [left, upper, right, lower] texts are cut: x, y
    [pixels]."""
    red, green, blue = np.asarray(Image.open(path).convert("RGB").crop(sidebar), np.int16).T
    most, least = (each(each(red, green), blue) for each in (np.maximum, np.minimum))
    light = np.where(most - least < 12, red + green + blue, 0).T
    low, high = ndimage.minimum_filter(light, BLOCK), ndimage.maximum_filter(light, BLOCK)
    found, _ = ndimage.label((low > 330) & (high - low < 20))
    return [(part[1].start + sidebar[0], part[0].start + sidebar[1])
            for part in ndimage.find_objects(found)]


def test_no_text_is_cut(run, blender, environment, tmp_path):
    """Every panel with all parts open, at the start, and of the example with all settings; and
    errors, the longest drawn, all of them measured. That a cut is seen at all, a panel shows."""
    require_screen()
    write_font(tmp_path / "cut.ttf")
    errors = sorted(told(), key=lambda one: -len(json.dumps(one[1])))
    (tmp_path / "errors.json").write_text(json.dumps(errors))
    seen = driven("drive_panels.py", blender, environment, tmp_path, SIZE)
    x, y, width, height = seen["sidebar"]
    sidebar = (x, SIZE[1] - y - height, x + width, SIZE[1] - y)
    assert width > 250 and height > 2000
    assert cuts(tmp_path / "cut.png", sidebar), "a text that is too wide is seen to be cut"
    pictures = list(tmp_path.glob("*_*.png"))
    assert len(pictures) == 2 * seen["panels"] > 20
    assert {path.name: at for path in [*pictures, tmp_path / "errors.png"]
            if (at := cuts(path, sidebar))} == {}
    assert seen["error_count"] == len(errors) > 400
    assert seen["too_wide"] == []
