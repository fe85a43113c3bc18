"""Rules of the layout: the core never imports bpy, the add-on holds no mathematics."""

import ast
import doctest
import functools
import importlib
import re
import subprocess
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

from limber.core.optional import DISTRIBUTION

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Source:
    """What these rules look at in a Python file.

    Attributes:
        imports: All statements that import.
        calls: Line and dotted name of what is called.
        attributes: Line and dotted name of what is looked up with a dot.
    """

    imports: list[ast.Import | ast.ImportFrom]
    calls: list[tuple[int, str]]
    attributes: list[tuple[int, str]]


@functools.cache
def source(path: Path) -> Source:
    """Read a file once for all rules."""
    found = Source([], [], [])
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import | ast.ImportFrom):
            found.imports.append(node)
        elif isinstance(node, ast.Call):
            found.calls.append((node.lineno, _dotted(node.func)))
        elif isinstance(node, ast.Attribute):
            found.attributes.append((node.lineno, _dotted(node)))
    return found


def _dotted(node: ast.expr) -> str:
    """Return ``a.b.c`` of names and dots; of anything else nothing."""
    if isinstance(node, ast.Attribute):
        before = _dotted(node.value)
        return f"{before}.{node.attr}" if before else ""
    return node.id if isinstance(node, ast.Name) else ""


@functools.cache
def imported_modules(folder: Path) -> dict[Path, set[str]]:
    """Return, for each Python file below ``folder``, the top-level names of what it imports."""
    found = {}
    for path in folder.rglob("*.py"):
        names = set()
        for node in source(path).imports:
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif node.level == 0:
                names.add((node.module or "").split(".")[0])
        found[path] = names
    return found


@pytest.mark.slow
def test_core_never_imports_bpy():
    """No file of worker/limber imports bpy or another Blender module."""
    blender = {"bpy", "bmesh", "mathutils", "gpu", "bl_ext"}
    modules = imported_modules(ROOT / "worker" / "limber")
    assert modules
    assert not {str(path) for path, names in modules.items() if names & blender}


def test_addon_computes_nothing():
    """The add-on imports no numerical package but numpy (its arrays) and nothing of the core."""
    numerical = {"scipy", "cvxopt", "trimesh", "limber", "networkx", "pytetwild"}
    # Only the script that is the worker's process, where its wheels came with the extension.
    modules = {path: names for path, names in imported_modules(ROOT / "addon").items()
               if path.name != "bundled.py"}
    assert modules
    assert not {str(path) for path, names in modules.items() if names & numerical}


def test_what_the_addon_takes_of_the_worker_imports_no_limber():
    """The build puts this file beside the add-on's own."""
    path = CORE / "core" / "files" / "text_columns.py"
    assert "limber" not in imported_modules(path.parent)[path]


def test_benches_need_no_tests():
    """They measure where no tests are; tests may take their subjects."""
    modules = imported_modules(ROOT / "worker" / "benchmarks")
    assert modules
    assert not {str(path) for path, names in modules.items() if "tests" in names}


def test_top_level_is_as_designed():
    """Only the designed folders and the files that tools expect stand at the top."""
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True,
                             check=True).stdout.splitlines()
    top = {name.split("/")[0] for name in tracked}
    allowed = {"addon", "worker", "tests", "blend_files", "scripts", ".ci", "README.md",
               "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "MANIFEST.in",
               "pyproject.toml", "requirements.lock", "setup.py", ".github", ".gitignore",
               ".gitattributes", ".pre-commit-config.yaml"}
    assert top <= allowed


def test_nothing_names_an_index_or_this_machine():
    """No tracked file names a package index's host or a path of the machine it was made on."""
    pattern = re.compile(rb"pypi\.org|pythonhosted|deb\.debian\.org|--index-url|--extra-index")
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True,
                             check=True).stdout.splitlines()
    wrong = [name for name in tracked if name != "tests/test_structure.py"
             and (ROOT / name).is_file() and pattern.search((ROOT / name).read_bytes())]
    assert not wrong


def test_no_text_advises_the_stranger_of_our_name():
    """The package index's `limber` is another program: ours is `limber-branch`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["name"] == DISTRIBUTION
    # `pip install 'limber[report]'`, `pip install -U limber`, limber[report], limber==0.1.
    pattern = re.compile(r"(pip3?|pipx|uv|conda|mamba)\s+(install|download|add|run|tool)\b[^\n`]*"
                         r"[\s'\"]limber(?![\w/.-])|(?<![\w.-])limber(\[[a-z$]|\s*[=~<>]=\s*\d)")
    assert all(map(pattern.search, (
        "pip install limber", "pip install 'limber[report]'", "python -m pip install -U limber\n",
        "`limber[robot]`", "limber==0.1", "uv pip install limber")))
    assert not any(map(pattern.search, ("pip install limber-branch", "uv run limber-branch",
                                        "'build/limber_branch-0.1-py3-none-any.whl[report]'")))
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True,
                             check=True).stdout.splitlines()
    wrong = [name for name in tracked if name != "tests/test_structure.py"
             and (ROOT / name).is_file()
             and pattern.search((ROOT / name).read_text(encoding="utf-8", errors="replace"))]
    assert not wrong


CORE = ROOT / "worker" / "limber"

# Lines between processes of ours, and lines that a killed program may have left half written.
OWN_LINES = {"robot", "session", "core.json_values", "batch.batch_progress", "store.lock",
             "geometry.tets.tetwild_process"}


@pytest.mark.slow
def test_files_come_in_through_one_door():
    """JSON, TOML and arrays are read by limber.core.files.reading, which checks them, alone."""
    doors = ("json.loads", "json.load", "tomllib.loads", "tomllib.load", "np.load",
             "np.genfromtxt", "np.fromfile", "pickle.load")
    wrong = []
    for path in CORE.rglob("*.py"):
        module = ".".join(path.relative_to(CORE).with_suffix("").parts)
        if module == "core.files.reading" or any(
                module == name or module.startswith(name + ".") for name in OWN_LINES):
            continue
        wrong += [f"limber.{module}, line {line}: {name}" for line, name in source(path).calls
                  if name in doors]
    assert not wrong


@pytest.mark.slow
def test_only_stages_open_branch_folders():
    """Branch.open and Branch.create are called by stages, the session and the store alone."""
    allowed = {"stages", "session", "store", "cli"}
    wrong = []
    for path in CORE.rglob("*.py"):
        if path.relative_to(CORE).parts[0] in allowed:
            continue
        wrong += [f"{path.relative_to(CORE)}:{line}" for line, name in source(path).attributes
                  if name in ("Branch.open", "Branch.create")]
    assert not wrong


@pytest.mark.parametrize("package", ["geometry", "mechanics", "recordings", "estimation",
                                     "planning", "core.json_values"])
def test_public_names_are_there(package):
    """All that a package exports loads, and the example in its docstring runs."""
    module = importlib.import_module(f"limber.{package}")
    for name in getattr(module, "__all__", ()):
        assert getattr(module, name).__doc__, name
    flags = doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL
    failed, tried = doctest.testmod(module, optionflags=flags)
    assert tried and not failed


@pytest.mark.slow
def test_dependencies_are_imported():
    """Every dependency in pyproject.toml is imported by the core or called by it by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    imported = set().union(*imported_modules(CORE).values())
    modules = {"pillow": "PIL", "ur-rtde": "rtde_control"}
    unused = []
    for wanted in project["dependencies"]:
        name = re.split(r"[^\w-]", wanted)[0]
        if modules.get(name, name).replace("-", "_") not in imported:
            unused.append(name)
    assert not unused


def test_no_test_asserts_a_duration():
    """Machines differ: a test counts the work. Waits may end, and robots are held to their clocks
    (mark ``real_time``), where a failure says what the machine did."""
    clocks = {"time.monotonic", "time.perf_counter", "time.process_time", "time.time"}
    found = []
    for path in sorted((ROOT / "tests").rglob("*.py")):
        if path.is_relative_to(ROOT / "tests" / "robot"):
            continue
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text if any(one in text for one in (*clocks, '["seconds"]')) else "")
        for node in ast.walk(tree):
            if not isinstance(node, ast.Assert):
                continue
            spent = [each for each in ast.walk(node.test)
                     if isinstance(each, ast.BinOp) and isinstance(each.op, ast.Sub)
                     and isinstance(each.left, ast.Call) and _dotted(each.left.func) in clocks]
            compared = [each for each in ast.walk(node.test) if isinstance(each, ast.Compare)
                        and isinstance(each.ops[0], ast.Lt | ast.LtE)
                        and ast.unparse(each.left).endswith("['seconds']")]
            if spent or compared:
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert not found, f"these assert how long something took: {', '.join(found)}"
