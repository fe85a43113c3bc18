"""Rules of the layout: the core never imports bpy, the add-on holds no mathematics."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]


def imported_modules(folder: Path) -> dict[Path, set[str]]:
    """Return, for each Python file below ``folder``, the top-level names of what it imports."""
    found = {}
    for path in folder.rglob("*.py"):
        names = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names.add((node.module or "").split(".")[0])
        found[path] = names
    return found


def test_core_never_imports_bpy():
    """No file of worker/limber imports bpy or another Blender module."""
    blender = {"bpy", "bmesh", "mathutils", "gpu", "bl_ext"}
    modules = imported_modules(ROOT / "worker" / "limber")
    assert modules
    assert not {str(path) for path, names in modules.items() if names & blender}


def test_addon_computes_nothing():
    """The add-on imports no numerical package but numpy (its arrays) and nothing of the core."""
    numerical = {"scipy", "numba", "cvxopt", "trimesh", "limber", "networkx", "pytetwild"}
    modules = imported_modules(ROOT / "addon")
    assert modules
    assert not {str(path) for path, names in modules.items() if names & numerical}


def test_top_level_is_as_designed():
    """Only the designed folders and the files that tools expect stand at the top."""
    import subprocess

    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True,
                             check=True).stdout.splitlines()
    top = {name.split("/")[0] for name in tracked}
    allowed = {"addon", "worker", "tests", "blend_files", "scripts", ".ci", "README.md",
               "CHANGELOG.md", "LICENSE", "MANIFEST.in", "pyproject.toml", "requirements.lock",
               "setup.py", ".gitignore", ".gitattributes"}
    assert top <= allowed


def test_nothing_names_an_index_or_this_machine():
    """No tracked file names a package index's host or a path of the machine it was made on."""
    import re
    import subprocess

    pattern = re.compile(rb"pypi\.org|pythonhosted|deb\.debian\.org|--index-url|--extra-index")
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True,
                             check=True).stdout.splitlines()
    wrong = [name for name in tracked if name != "tests/test_structure.py"
             and (ROOT / name).is_file() and pattern.search((ROOT / name).read_bytes())]
    assert not wrong
