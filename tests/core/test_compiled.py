"""Compiled kernels are kept, and what is kept never stands in the way."""

import importlib
import importlib.util
import json
import os
import platform
import subprocess
import sys
import warnings

import pytest

from limber.cli.main import call
from limber.cli.stage_command import StageCommand
from limber.core.errors import DamagedCacheWarning
from limber.core.files import caches
from limber.core.numerics import compiled
from limber.core.processes.pool import Pool
from limber.core.progress import report_damage_to
from limber.stages.registry import stage_class


@pytest.fixture
def imported(tmp_path, monkeypatch):
    """Imports a module of the test's folder, and all that it imports from there, as a new process
    would; returns what it says."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def forget():
        for path in tmp_path.glob("*.py"):
            sys.modules.pop(path.stem, None)

    def said(name):
        forget()
        importlib.invalidate_caches()
        compiled._digest_of.cache_clear()
        return importlib.import_module(name).said
    yield said
    forget()


INNER = """
from limber.core.numerics.compiled import compiled

FACTOR = {factor}

@compiled
def inner(value):
    return FACTOR * value + {added}
"""
OUTER = """
from limber.core.numerics.compiled import compiled
from inner import inner

@compiled
def outer(value):
    return middle(value)

@compiled
def middle(value):
    return inner(value)

said = outer(1.0), len(outer._cache_hits)
"""


@pytest.mark.slow
def test_another_files_change_is_noticed_and_a_new_date_is_not(tmp_path, imported):
    """A kernel that is inlined from another file, and a constant of that file; numba alone looks at
    the date of the kernel's own file."""
    (tmp_path / "outer.py").write_text(OUTER)

    def run(factor, added):
        (tmp_path / "inner.py").write_text(INNER.format(factor=factor, added=added))
        os.utime(tmp_path / "outer.py")
        return imported("outer")
    assert run(2.0, 1.0) == (3.0, 0)
    assert run(2.0, 1.0) == (3.0, 1)
    assert run(2.0, 5.0) == (7.0, 0)
    assert run(3.0, 5.0) == (8.0, 0)


@pytest.mark.slow
def test_that_it_compiles_is_told_once(tmp_path):
    """Before the first kernel is compiled; not where it is kept."""
    (tmp_path / "kernel.py").write_text("""
from limber.core.numerics.compiled import compiled, when_compiling

@compiled
def twice(value):
    return value + value

when_compiling(lambda: print("compiling"))
print(twice(1.0), twice(2))
""")
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    told = [subprocess.run([sys.executable, str(tmp_path / "kernel.py")], check=True, text=True,
                           env=environment, capture_output=True).stdout.splitlines()
            for _ in range(2)]
    assert told == [["compiling", "2.0 4"], ["2.0 4"]]


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """A function that runs a kernel kept in a folder, as a new process would; and that folder."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache" / "numba"))
    path = tmp_path / "kernel.py"
    path.write_text("from limber.core.numerics.compiled import compiled\n\n\n@compiled\n"
                    "def twice(value):\n    return value + value\n")

    def run():
        """Returns the result, whether it was compiled, and what was warned of."""
        monkeypatch.setattr(compiled, "_reported_damage", [])
        spec = importlib.util.spec_from_file_location("kernel", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            results = module.twice(1.5), module.twice(2)
        assert all(issubclass(one.category, DamagedCacheWarning) for one in told)
        return (results, 2 - len(module.twice._cache_hits), [str(one.message) for one in told])
    assert run() == ((3.0, 4), 2, [])
    assert run() == ((3.0, 4), 0, [])
    return run, tmp_path / "cache"


def _half(path):
    path.write_bytes(path.read_bytes()[:path.stat().st_size // 2])


def _flipped(path):
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle:middle + 200] = bytes(200)
    path.write_bytes(content)


DAMAGES = {"empty": lambda path: path.write_bytes(b""), "cut": _half,
           "of other bytes": lambda path: path.write_bytes(os.urandom(500)),
           "with other bytes inside": _flipped, "whole, but of another name": lambda path:
               path.write_bytes(max({*path.parent.iterdir()} - {path}).read_bytes())}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_a_damaged_file_is_renewed_and_told_once(kept, suffix, damage):
    """An index or code: the kernel runs, one warning names a file, and the next run is as ever."""
    run, folder = kept
    files = sorted(folder.rglob(f"*{suffix}"))
    assert files
    for file in files:
        DAMAGES[damage](file)
    results, compiled_count, told = run()
    assert results == (3.0, 4) and compiled_count == 2
    assert len(told) == 1 and str(files[0].parent) in told[0] and "compiled again" in told[0]
    assert run() == ((3.0, 4), 0, [])


def test_shipped_kernels_are_used_and_never_changed(kept, monkeypatch, tmp_path):
    """Compiled elsewhere; a type that they lack is compiled into the user's folder."""
    run, folder = kept
    shipped = tmp_path / "shipped"
    (folder / "numba").rename(shipped)
    next(shipped.glob("*.2.nbc")).unlink()
    before = {path.name: path.read_bytes() for path in shipped.iterdir()}
    compiled.cache_folder().mkdir()
    monkeypatch.setattr(compiled, "SHIPPED", shipped)
    assert run() == ((3.0, 4), 1, [])
    assert len(list(folder.rglob("*.nbc"))) == 1
    assert run() == ((3.0, 4), 0, [])
    assert {path.name: path.read_bytes() for path in shipped.iterdir()} == before


@pytest.mark.slow
def test_all_processors_of_a_kind_get_the_same_instructions():
    """As the kernels' files say, which may come from another machine; a user's choice stands."""
    code = ("import limber.core.numerics.compiled, numba.core.registry as registry;"
            "print(*registry.cpu_target.target_context.codegen().magic_tuple()[1:])")

    def said(**extra):
        known = {name: value for name, value in os.environ.items() if "NUMBA_CPU" not in name}
        return subprocess.run([sys.executable, "-c", code], check=True, text=True,
                              env=known | extra, capture_output=True).stdout.strip()
    if platform.machine().lower() in ("x86_64", "amd64"):
        assert said() == "x86-64-v3"
    assert said(NUMBA_CPU_NAME="generic") == "generic"


def test_a_missing_data_file_is_made_again(kept):
    """The index still names it: that is no damage."""
    run, folder = kept
    for file in folder.rglob("*.nbc"):
        file.unlink()
    assert run() == ((3.0, 4), 2, [])
    assert run() == ((3.0, 4), 0, [])


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_what_cannot_be_read_is_compiled_for_the_run(kept, suffix):
    """A folder in the place of the file: neither read nor replaced."""
    run, folder = kept
    for file in folder.rglob(f"*{suffix}"):
        file.unlink()
        file.mkdir()
    results, compiled_count, told = run()
    assert results == (3.0, 4) and compiled_count == 2
    assert len(told) == 1 and "cannot be read" in told[0]


def test_cache_clear_removes_empty_files_and_folders(kept, monkeypatch, capsys):
    """An empty file frees nothing and goes all the same."""
    run, folder = kept
    for file in folder.rglob("*.nbi"):
        file.write_bytes(b"")
    next(folder.rglob("*.nbc")).unlink()
    (next(folder.rglob("*.nbi")).parent / "kernel.nbi").mkdir()
    monkeypatch.setattr(caches, "cache_folder", lambda: folder)
    assert call(["cache", "--clear", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["caches"] == {
        "numba": {"file_count": 0, "byte_count": 0}}
    assert list(folder.rglob("*")) == [folder / "numba"]
    assert run()[2] == []


def test_a_command_says_it_once_as_its_own_warning(capsys):
    """One line, and among the warnings of its result, however many processes warn."""
    kept = []
    with StageCommand(stage_class("target"))._progress("none", kept):
        for number in range(3):
            warnings.warn(f"file {number} was damaged", DamagedCacheWarning, stacklevel=1)
    assert kept == ["file 0 was damaged"]
    assert capsys.readouterr().err == "warning: file 0 was damaged\n"


def _damaged(number):
    warnings.warn(f"file {number} was damaged", DamagedCacheWarning, stacklevel=1)
    return number


@pytest.mark.slow
def test_processes_of_a_pool_warn_through_the_command():
    """Two that find damage: one warning."""
    told = []
    with report_damage_to(told.append), Pool(2) as pool:
        assert sorted(pool.map(_damaged, [(0,), (1,)])) == [0, 1]
    assert len(told) == 1 and "was damaged" in told[0]
