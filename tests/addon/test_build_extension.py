"""scripts/build_extension: what is in the zip, with Blender's validator or without any."""

import importlib.machinery
import importlib.util
import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture()
def build():
    """The script, imported."""
    loader = importlib.machinery.SourceFileLoader("build_extension",
                                                  str(ROOT / "scripts" / "build_extension"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader(loader.name, loader))
    loader.exec_module(module)
    return module


def _wheel(folder, name, needs=(), **files):
    path = folder / name
    with zipfile.ZipFile(path, "w") as archive:
        package = "-".join(name.split("-")[:2])
        archive.writestr(f"{package}.dist-info/METADATA", "Metadata-Version: 2.1\n" + "".join(
            f"Requires-Dist: {need}\n" for need in needs))
        for part, content in files.items():
            archive.writestr(part.replace("__", "/") + ".so", content)
    return path


ELF = b"\x7fELF" + bytes(14) + b"\x3e\x00"
ARM_MAC = b"\xcf\xfa\xed\xfe\x0c\x00\x00\x01"


def test_wheels_are_judged_by_tag_content_and_what_they_require(build, tmp_path):
    """One that fits; another Python's, another machine's program under a fitting name, a
    requirement that is not there, one of too old a version, one that holds on Windows alone."""
    good = _wheel(tmp_path, "fits-1.0-cp311-cp311-manylinux_2_17_x86_64.manylinux2014_x86_64.whl",
                  ["needed>=2", "numpy>=1.26", "colorama; sys_platform == 'win32'",
                   "docs; extra == 'docs'"], fits=ELF)
    needed = _wheel(tmp_path, "Needed-2.1-py3-none-any.whl")
    assert build.wheels_trouble([good, needed], "linux-x64", "3.11") == []
    assert build.wheels_trouble([good], "linux-x64", "3.11") == [f"{good.name} requires needed>=2"]
    old = _wheel(tmp_path, "needed-1.9-py3-none-any.whl")
    assert build.wheels_trouble([good, old], "linux-x64", "3.11") == [
        f"{good.name} requires needed>=2"]
    assert "is not for Python 3.13" in build.wheels_trouble([good, needed], "linux-x64", "3.13")[0]
    stable = _wheel(tmp_path, "stable-1.0-cp36-abi3-macosx_11_0_arm64.whl", library=ARM_MAC)
    assert build.wheels_trouble([stable], "macos-arm64", "3.13") == []
    wrong = _wheel(tmp_path, "wrong-1.0-cp311-cp311-macosx_10_9_universal2.whl", library=ELF)
    assert build.wheels_trouble([wrong], "macos-arm64", "3.11") == [
        f"{wrong.name}: library.so is no program for macos-arm64"]
    on_windows = _wheel(tmp_path, "w-1.0-py3-none-win_amd64.whl",
                        ["colorama; sys_platform == 'win32'"])
    assert build.wheels_trouble([on_windows], "windows-x64", "3.13") == [
        f"{on_windows.name} requires colorama; sys_platform == 'win32'"]


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
