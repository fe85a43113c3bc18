"""The advice how to install what is missing."""

import importlib.metadata
import shlex
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from limber.core import optional
from limber.core.errors import MissingDependencyError

PIP = f"{shlex.quote(sys.executable)} -m pip install"
CHECKOUT = Path(__file__).parents[2]


@pytest.mark.parametrize("installer, advice", [
    ("pip", f"Install with `{PIP} 'limber-branch[report]'`."),
    ("uv", f"Install with `{PIP} 'limber-branch[report]'`."),
    (None, "Blender's extension does not bring it")])
def test_the_advice_is_for_the_way_limber_was_installed(monkeypatch, tmp_path, installer, advice):
    """As a wheel by a program, or unpacked by Blender, which leaves no name of an installer."""
    monkeypatch.setattr(optional, "__file__", str(tmp_path / "a" / "limber" / "core" / "x.py"))
    asked = []

    def distribution(name):
        asked.append(name)
        return SimpleNamespace(read_text=lambda part: installer if part == "INSTALLER" else None)

    monkeypatch.setattr(importlib.metadata, "distribution", distribution)
    assert optional.how_to_install("report").startswith(advice)
    assert asked == ["limber-branch"]


def test_in_a_checkout_the_advice_names_the_checkout():
    """With the Python at hand, not with that of the PATH."""
    with pytest.raises(MissingDependencyError) as caught:
        optional.require_extra("report", ("no_such_package",), "The report")
    assert str(caught.value) == (
        "no_such_package is not installed. The report needs it. Install with "
        f"`{PIP} -e {shlex.quote(f'{CHECKOUT}[report]')}`.")
