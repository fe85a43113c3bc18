"""The add-on's form: one version, relative imports, no mathematics, icons that exist."""

import ast
import re
import tomllib
from pathlib import Path

from limber.version import VERSION

ADDON = Path(__file__).parents[2] / "addon"
FILES = sorted(ADDON.rglob("*.py"))


def test_versions_agree():
    """The manifest carries the version of worker/limber/version.py."""
    manifest = tomllib.loads((ADDON / "blender_manifest.toml").read_text())
    assert manifest["version"] == VERSION
    assert manifest["id"] == "limber"


def test_no_mathematics():
    """No linear algebra, transforms or solvers: the worker computes, the add-on shows."""
    wrong = re.compile(r"linalg|scipy|np\.(dot|cross|einsum|matmul|interp|fft|gradient|exp|sqrt)\b")
    found = {path.name: wrong.findall(path.read_text()) for path in FILES}
    assert len(found) > 20
    assert not {name: hits for name, hits in found.items() if hits}


def test_imports_of_its_own_are_relative():
    """Blender names the package bl_ext.REPOSITORY.limber, so no file may know its name.

    What bundled.py imports is the worker: it is started as a program of its own.
    """
    wrong = []
    for path in [path for path in FILES if path.name != "bundled.py"]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                first = (node.module or "").split(".")[0]
                if first in {"addon", "limber"} | {path.name for path in ADDON.iterdir()
                                                      if path.is_dir()}:
                    wrong.append(f"{path.name}: {node.module}")
    assert not wrong


def test_only_the_scene_script_is_a_program():
    """Jobs and the search for the worker stay free of bpy: threads live there."""
    for name in ("jobs/jobs", "jobs/worker", "jobs/worker_process", "jobs/plain_words",
                 "scan/clouds", "scan/scans", "show/scene_data", "bend/session"):
        assert "import bpy" not in (ADDON / f"{name}.py").read_text()


def test_a_folder_is_one_action_of_the_user():
    """At most 16 files in a folder, and at the top only what Blender and the build ask for."""
    folders = {path.parent for path in FILES}
    assert len(folders) >= 10
    counts = {folder.name: len(list(folder.glob("*.py"))) for folder in folders}
    assert not {name: count for name, count in counts.items() if count > 16}
    assert counts["addon"] <= 6


def test_every_icon_exists(bpy):
    """An icon that a Blender lacks breaks the panel that names it."""
    known = set(bpy.types.UILayout.bl_rna.functions["prop"].parameters["icon"].enum_items.keys())
    used = {icon for path in FILES
            for call in re.findall(r"icon=([^)\n]+)", path.read_text())
            for icon in re.findall(r'"([A-Z_0-9]+)"', call)}
    assert "FILE_FOLDER" in used
    used |= set(re.findall(r'= \("[^"]+", "([A-Z_]+)"\)', (ADDON / "jobs/steps.py").read_text()))
    assert "RADIOBUT_OFF" in used
    assert used <= known
