"""Compiled kernels are kept, and what is kept never stands in the way."""

import os
import subprocess
import sys

KERNEL = """
from limber.compiled import compiled
from {place} import Pair

@compiled
def total(pair):
    return pair.a + pair.b

print(total(Pair(1.0, 2.0)), len(total._cache_hits))
"""
PAIR = """
from typing import NamedTuple

class Pair(NamedTuple):
    a: float
    b: float
"""


def test_a_moved_type_is_compiled_anew(tmp_path):
    """A kernel kept with an argument's type that has since moved to another module still runs,
    and is then kept again.
    """
    kernel = tmp_path / "kernel.py"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def run(place):
        (tmp_path / f"{place}.py").write_text(PAIR)
        if not kernel.exists() or place not in kernel.read_text():
            kernel.write_text(KERNEL.format(place=place))
        done = subprocess.run([sys.executable, str(kernel)], check=False, env=environment,
                              capture_output=True, text=True)
        (tmp_path / f"{place}.py").unlink()
        assert done.returncode == 0, done.stderr
        return done.stdout.split()
    assert run("before") == ["3.0", "0"]
    assert run("after") == ["3.0", "0"]
    assert run("after") == ["3.0", "1"]


def test_that_it_compiles_is_told_once(tmp_path):
    """Before the first kernel is compiled; not where it is kept."""
    (tmp_path / "kernel.py").write_text("""
from limber.compiled import compiled, when_compiling

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
