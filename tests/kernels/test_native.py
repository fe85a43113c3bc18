"""The native kernels: their declarations, what they refuse, and the same digits everywhere."""

import importlib
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.subjects.meshes import box_mesh

from limber.geometry.rigid_kernels import SMALL_KERNELS
from limber.kernels import Kernel
from limber.mechanics import BranchModel
from limber.mechanics.elements.forces import sparse_times

SOURCES = Path(__file__).parents[2] / "worker" / "kernels"
C_TYPES = {"bool": "uint8_t*", "float64": "double*", "int64": "int64_t*", "int32": "int32_t*",
           "int": "int64_t", "float": "double"}


def test_declarations_are_the_functions():
    """Each kernel is declared with the types of its C++ function, arrays, plain values and sizes;
    and each function is declared."""
    worker, defined, kernels = SOURCES.parent, {}, {}
    for path in (worker / "limber").rglob("*.py"):
        if re.search(r"^from limber.kernels import .*Kernel", path.read_text("utf-8"), re.M):
            name = ".".join(path.relative_to(worker).with_suffix("").parts)
            kernels |= {value.name: value for value in vars(importlib.import_module(name)).values()
                        if isinstance(value, Kernel)}
    for path in SOURCES.rglob("*.cpp"):
        for kind, name, words in re.findall(r"^KERNEL (\w+) (\w+)\((.*?)\) \{", path.read_text(
                "utf-8"), re.M | re.S):
            defined[name] = kind, [re.match(r"(?:const )?(\w+\*?)", word.strip())[1]
                                   for word in words.split(",") if word]
    del defined["has_wide_vectors"], defined["arrays_fit"]
    importlib.import_module("limber.robot.virtual.step_kernels")
    for name, arguments in SMALL_KERNELS.items():
        wanted = ["char*" if "[" in part else "double" for part in arguments]
        assert defined.pop(name) == ("bool", [*wanted, "char*", "int64_t"]), name
    assert set(kernels) == set(defined)
    for name, kernel in kernels.items():
        kind, found = defined[name]
        sizes = {axis for axes in kernel._axes for axis in axes if not axis.isdecimal()}
        wanted = [C_TYPES[re.sub(r"\[.*", "", part).split()[-1]] for part in kernel._declared]
        assert found == wanted + ["int64_t"] * len(sizes), name
        assert kind == {"": "void", "int": "int64_t", "float": "double"}[kernel._returns], name


@pytest.mark.parametrize(("number", "value"), [
    (0, np.zeros(4, np.int64)), (1, np.zeros(3, np.int32)), (3, np.zeros((3, 2))),
    (3, np.zeros((6, 3))[::2]), (4, np.broadcast_to(0.0, (3, 3)))])
def test_other_arrays_are_refused(number, value):
    arrays = [np.array([0, 1, 1, 2], np.int32), np.array([0, 2], np.int32), np.array([2.0, 3]),
              np.ones((3, 3)), np.empty((3, 3))]
    sparse_times(*arrays)
    assert arrays[4].tolist() == [[2, 2, 2], [0, 0, 0], [3, 3, 3]]
    arrays[number] = value
    with pytest.raises(TypeError, match="kernel sparse_times wants starts int32"):
        sparse_times(*arrays)


def test_what_is_no_array_is_refused():
    """Lists, numbers, nothing; and byte orders of other machines."""
    good = [np.array([0, 1], np.int32), np.array([0], np.int32), np.ones(1), np.ones((1, 3)),
            np.empty((1, 3))]
    for number, value in ((0, [0, 1]), (2, 1.0), (4, None), (2, np.ones(1, ">f8"))):
        with pytest.raises(TypeError, match="kernel sparse_times wants"):
            sparse_times(*good[:number], value, *good[number + 1:])


def digits() -> str:
    """The digits of a force, a tangent and a solution."""
    model = BranchModel(box_mesh(), young=1e7, poisson=0.3, density=900)
    u = 1e-4 * np.random.default_rng(1).standard_normal(model.mesh.nodes.shape)
    tangent = model.equations().tangent(model, u)
    return model.internal(u).force.tobytes().hex() + tangent.solve(u).tobytes().hex()


@pytest.mark.slow
def test_processors_without_avx2_give_the_same_digits():
    script = "import tests.kernels.test_native as own; print(own.digits())"
    found = subprocess.check_output([sys.executable, "-c", script], cwd=SOURCES.parents[1],
                                    env=os.environ | {"LIMBER_KERNELS": "v2"}, text=True)
    assert found.strip() == digits()


@pytest.mark.slow
def test_a_changed_source_is_built_again(tmp_path):
    for name in ("build.py", "lanes.hpp", "processor.cpp"):
        shutil.copy(SOURCES / name, tmp_path)

    def build() -> int:
        runpy.run_path(str(tmp_path / "build.py"))["build"](tmp_path / "made")
        return max(path.stat().st_mtime_ns for path in (tmp_path / "made").iterdir())

    first = build()
    assert build() == first
    shutil.copy(SOURCES / "lanes.hpp", tmp_path / "another.hpp")
    assert build() > first
