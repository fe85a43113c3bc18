"""scripts/build_extension: what is in the zip, with Blender's validator or without any."""

import importlib.machinery
import importlib.util
import json
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
                  ["needed>=2", "numpy>=1.20", "colorama; sys_platform == 'win32'",
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


def test_numpy_is_judged_by_the_oldest_blender(build, tmp_path):
    """Blender 4.2 has 1.24.3: what wants a newer one needs the worker's own beside it."""
    wants = _wheel(tmp_path, "wants-1.0-py3-none-any.whl", ["numpy>=1.26.4,<2.7"])
    assert build.wheels_trouble([wants], "linux-x64", "3.11") == [
        f"{wants.name} requires numpy>=1.26.4,<2.7"]
    assert build.wheels_trouble([wants], "linux-x64", "3.13") == []
    own = _wheel(tmp_path, "limber_numpy-1.26.4-cp311-cp311-manylinux_2_17_x86_64.whl")
    assert build.wheels_trouble([wants, own], "linux-x64", "3.11") == []
    assert build.brings_numpy("3.11", "1.26") and not build.brings_numpy("3.13", "2.1")


def test_the_workers_numpy_is_found_by_the_worker_alone(build, tmp_path):
    """Unpacked as Blender unpacks it: a process that searches the folder first does not find it;
    the worker does, and what the worker starts."""
    wheel = tmp_path / "numpy-9.9-cp311-cp311-manylinux_2_17_x86_64.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("numpy/__init__.py", "__version__ = '9.9'")
        archive.writestr("numpy/core/tests/test_all.py", "")
        archive.writestr("numpy-9.9.dist-info/METADATA", "Name: numpy\nVersion: 9.9\n")
    made = build.hidden_numpy(wheel)
    assert made.name == "limber_numpy-9.9-cp311-cp311-manylinux_2_17_x86_64.whl"
    assert build.wheels_trouble([made], "linux-x64", "3.11") == []
    folder = tmp_path / "site-packages"
    with zipfile.ZipFile(made) as archive:
        assert not [name for name in archive.namelist() if "tests" in name]
        archive.extractall(folder)
    (folder / "limber" / "cli").mkdir(parents=True)
    (folder / "limber" / "__init__.py").touch()
    (folder / "limber" / "cli" / "main.py").write_text(
        "import subprocess, sys\nimport numpy\n\n\ndef run():\n"
        "    print(numpy.__version__, flush=True)\n"
        "    subprocess.run([sys.executable, '-c', 'import numpy; print(numpy.__version__)'])\n")
    worker = subprocess.run([sys.executable, ROOT / "addon" / "bundled.py", folder], check=True,
                            capture_output=True, text=True)
    assert worker.stdout.split() == ["9.9", "9.9"]
    blender = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(folder)!r}); import numpy; "
         "print(numpy.__version__)"], check=True, capture_output=True, text=True)
    assert blender.stdout.strip() != "9.9"


def test_the_zip_is_for_the_blenders_with_its_python(build):
    """Another Blender refuses it before it unpacks anything; a Python that none has is refused."""
    plain = (ROOT / "addon" / "blender_manifest.toml").read_text()
    wheel = Path("a-1.0-py3-none-any.whl")
    made = {python: tomllib.loads(build.with_wheels(plain, [wheel], "linux-x64", python))
            for python in ("3.11", "3.13", "3.14")}
    assert [(each["blender_version_min"], each.get("blender_version_max"))
            for each in made.values()] == [
                ("4.2.0", "5.1.0"), ("4.3.0", None), ("5.2.0", None)]
    assert made["3.11"]["wheels"] == [f"./wheels/{wheel.name}"]
    assert made["3.11"]["permissions"] == tomllib.loads(plain)["permissions"]
    with pytest.raises(SystemExit, match=r"no Blender has Python 3\.15.*3\.11, 3\.13, 3\.14"):
        build.blender_versions("3.15")


@pytest.fixture()
def own_bpy(bpy):
    """The bpy package of .venv, not of another folder."""
    if not list((ROOT / ".venv").glob("lib/python3*/site-packages/bpy")):
        pytest.skip("NO BPY in .venv: scripts/setup --with-blender")


def test_a_repository_names_the_python_of_each_zip(build, tmp_path, own_bpy):
    """Blender then takes the zip for its Python alone; the zip without wheels is not listed."""
    plain = (ROOT / "addon" / "blender_manifest.toml").read_text()
    (tmp_path / "limber-0.1.0.zip").touch()
    for python in ("3.11", "3.13"):
        tag = python.replace(".", "")
        wheels = [_wheel(tmp_path, f"a-1.0-cp{tag}-cp{tag}-manylinux_2_17_x86_64.whl", a=ELF),
                  _wheel(tmp_path, "b-1.0-py3-none-any.whl")]
        with zipfile.ZipFile(tmp_path / f"limber-0.1.0-linux-x64-py{tag}.zip", "w") as archive:
            archive.writestr("blender_manifest.toml",
                             build.with_wheels(plain, wheels, "linux-x64", python))
            archive.writestr("__init__.py", "")
            for wheel in wheels:
                archive.write(wheel, f"wheels/{wheel.name}")
    subprocess.run([sys.executable, ROOT / "scripts" / "make_repository", tmp_path], check=True)
    listed = json.loads((tmp_path / "index.json").read_text())["data"]
    assert {each["archive_url"]: each["python_versions"] for each in listed} == {
        "./limber-0.1.0-linux-x64-py311.zip": ["3.11"],
        "./limber-0.1.0-linux-x64-py313.zip": ["3.13"]}


def test_a_worker_that_does_not_load_says_what_to_do(tmp_path):
    """Wheels of another Python or a numpy too old: a sentence, not a trace."""
    package = tmp_path / "limber" / "cli"
    package.mkdir(parents=True)
    for folder in (package, package.parent):
        (folder / "__init__.py").touch()
    (package / "main.py").write_text("import numpy_that_is_too_old")
    done = subprocess.run([sys.executable, ROOT / "addon" / "bundled.py", tmp_path, "plan",
                           "--json"], check=False, capture_output=True, text=True)
    assert done.returncode == 3 and "Traceback" not in done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["status"] == "failed"
    assert "numpy_that_is_too_old" in told["error"]
    assert "Install the extension's zip" in told["error"]


def test_a_python_without_the_tools_is_told_in_one_line(build, tmp_path, monkeypatch):
    """A system's Python with an old setuptools: .venv's is taken, or it is said what is missing."""
    lacking, root = tmp_path / "lacking", tmp_path / "root"
    lacking.write_text("#!/bin/sh\nexit 1\n")
    lacking.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(lacking))
    monkeypatch.setattr(build, "ROOT", root)
    root.mkdir()
    shutil.copy(ROOT / "pyproject.toml", root)
    with pytest.raises(SystemExit, match=r"lacks one of pip, packaging, setuptools.*setup"):
        build.builder()
    own = root / ".venv" / "bin" / "python"
    own.parent.mkdir(parents=True)
    own.write_text("#!/bin/sh\nexit 0\n")
    own.chmod(0o755)
    assert build.builder() == str(own)


def _build(root, out):
    environment = {key: value for key, value in os.environ.items() if key != "LIMBER_BLENDER"}
    environment["PATH"] = os.path.dirname(sys.executable) + os.pathsep + "/usr/bin:/bin"
    if shutil.which("blender", path=environment["PATH"]):
        pytest.skip("a Blender is on the system's PATH: test_real_blender.py builds with it")
    done = subprocess.run([sys.executable, root / "scripts" / "build_extension", "--output-dir",
                           out], check=False, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return Path(done.stdout.splitlines()[-1]), done.stderr


def _copy_scripts(root):
    for name in ("scripts/build_extension", "scripts/check_dependencies", "requirements.lock",
                 "worker/limber/core/files/text_columns.py"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, root / name)
    for name in ("worker/docs", "blend_files/manual"):
        shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))


def _check(path):
    with zipfile.ZipFile(path) as archive:
        names = set(archive.namelist())
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
    assert path.name == f"limber-{manifest['version']}.zip"
    sources = {file.relative_to(ROOT / "addon").as_posix()
               for file in (ROOT / "addon").rglob("*.py")}
    assert sources | {"sbom.cdx.json", "guide/howto/scan.html", "text_columns.py"} <= names
    assert not [name for name in names if "__pycache__" in name or name.endswith(".pyc")]


@pytest.mark.slow
def test_by_the_bpy_package(tmp_path, own_bpy):
    """Blender's own validator, as the bpy package of .venv has it, accepts folder and zip."""
    path, said = _build(ROOT, tmp_path)
    assert "valid according to" in said
    _check(path)
    with zipfile.ZipFile(path) as archive:
        assert {"example/bending_branch.blend", "example/bending_branch/branch.json"} <= set(
            archive.namelist())


@pytest.mark.slow
def test_without_any_blender(tmp_path):
    """With neither, the zip is made all the same, and what was not checked is said."""
    shutil.copytree(ROOT / "addon", tmp_path / "addon")
    _copy_scripts(tmp_path)
    path, said = _build(tmp_path, tmp_path / "out")
    assert "NOT checked" in said
    _check(path)


@pytest.mark.slow
def test_an_invalid_manifest_is_refused(tmp_path, own_bpy):
    """A tagline that Blender does not take ends the build with an error."""
    shutil.copytree(ROOT / "addon", tmp_path / "addon")
    _copy_scripts(tmp_path)
    (tmp_path / ".venv").symlink_to(ROOT / ".venv")
    manifest = tmp_path / "addon" / "blender_manifest.toml"
    manifest.write_text(manifest.read_text().replace("scanned ones do", "scanned ones do."))
    with pytest.raises(AssertionError, match="tagline"):
        _build(tmp_path, tmp_path / "out")


@pytest.mark.parametrize(("refusals", "says"), [(2, "installed"), (1000, "could not install")])
def test_provisioning_waits_for_apts_lock(tmp_path, refusals, says):
    """Another apt holds it for a while: tried again; for ever: said with apt's own words."""
    apt = f"""cd {tmp_path}; n=$(cat n 2>/dev/null || echo 0); echo $((n + 1)) > n
        [ "$n" -ge {refusals} ] || {{ echo "E: Could not get lock x" >&2; exit 100; }}"""
    stubs = {"apt-get": apt, "sleep": f"echo $1 >> {tmp_path}/slept"}
    for name, body in stubs.items():
        (tmp_path / name).write_text(f"#!/bin/bash\n{body}\n")
        (tmp_path / name).chmod(0o755)
    script = (ROOT / "scripts" / "provision_blender").read_text()
    functions = script[script.index("say() {"):script.index("debian_mirror() {")]
    done = subprocess.run(
        ["bash", "-c", f"{functions}\ninstall_on_host no-such-program a && echo installed"],
        check=False, capture_output=True, text=True,
        env={"PATH": f"{tmp_path}:/usr/bin:/bin"})
    assert says in done.stdout + done.stderr
    waits = (tmp_path / "slept").read_text().split()
    assert waits == ["5"] * min(refusals, 60)
    assert ("Could not get lock" in done.stderr) == (refusals > 60)


def test_requirements_of_another_system(build):
    """By its markers: OMPL has no wheel for Windows and Python 3.14, numpy is of two versions."""
    needs = ["ompl; sys_platform != 'win32' and python_version < '3.14'", "a[b]>=2",
             "numpy==1.26.4 ; python_full_version < '3.12' "]
    assert build.holding(needs, "linux-x64", "3.11") == ["ompl", "a[b]>=2", "numpy==1.26.4"]
    assert build.holding(needs, "linux-x64", "3.14") == ["a[b]>=2"]
    assert build.holding(needs, "windows-x64", "3.13") == ["a[b]>=2"]
