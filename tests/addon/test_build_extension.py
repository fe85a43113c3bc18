"""scripts/build_extension: what is in the zip, with Blender's validator or without any."""

import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def _build(root, out):
    environment = {key: value for key, value in os.environ.items() if key != "LIMBER_BLENDER"}
    environment["PATH"] = os.path.dirname(sys.executable) + os.pathsep + "/usr/bin:/bin"
    if shutil.which("blender", path=environment["PATH"]):
        pytest.skip("a Blender is on the system's PATH: test_real_blender.py builds with it")
    done = subprocess.run([sys.executable, root / "scripts" / "build_extension", "--output-dir",
                           out], check=False, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return Path(done.stdout.splitlines()[-1]), done.stderr


def _check(path):
    with zipfile.ZipFile(path) as archive:
        names = set(archive.namelist())
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
    assert path.name == f"limber-{manifest['version']}.zip"
    sources = {file.relative_to(ROOT / "addon").as_posix()
               for file in (ROOT / "addon").rglob("*.py")}
    assert sources <= names
    assert not [name for name in names if "__pycache__" in name or name.endswith(".pyc")]


def test_by_the_bpy_package(tmp_path, bpy):
    """Blender's own validator, as the bpy package of .venv has it, accepts folder and zip."""
    if not list((ROOT / ".venv").glob("lib/python3*/site-packages/bpy")):
        pytest.skip("NO BPY in .venv: scripts/setup brings it")
    path, said = _build(ROOT, tmp_path)
    assert "valid, says" in said
    _check(path)
    with zipfile.ZipFile(path) as archive:
        assert {"example/bending_branch.blend", "example/bending_branch/branch.json"} <= set(
            archive.namelist())


def test_without_any_blender(tmp_path):
    """With neither, the zip is made all the same, and what was not checked is said."""
    shutil.copytree(ROOT / "addon", tmp_path / "addon")
    (tmp_path / "scripts").mkdir()
    shutil.copy(ROOT / "scripts" / "build_extension", tmp_path / "scripts")
    path, said = _build(tmp_path, tmp_path / "out")
    assert "NOT checked" in said
    _check(path)


def test_an_invalid_manifest_is_refused(tmp_path, bpy):
    """A tagline that Blender does not take ends the build with an error."""
    if not (ROOT / ".venv").is_dir():
        pytest.skip("NO .venv: scripts/setup brings it")
    shutil.copytree(ROOT / "addon", tmp_path / "addon")
    (tmp_path / "scripts").mkdir()
    shutil.copy(ROOT / "scripts" / "build_extension", tmp_path / "scripts")
    (tmp_path / ".venv").symlink_to(ROOT / ".venv")
    manifest = tmp_path / "addon" / "blender_manifest.toml"
    manifest.write_text(manifest.read_text().replace("scanned ones do", "scanned ones do."))
    with pytest.raises(AssertionError, match="tagline"):
        _build(tmp_path, tmp_path / "out")
