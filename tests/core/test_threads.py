"""One thread in every library, and results that do not depend on how many there were."""

import importlib.metadata
import os
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from packaging.requirements import Requirement
from tests.subjects.leafy import curved_leaves

from benchmarks.worlds.sources import sparse_case
from limber.core import optional
from limber.core.errors import MissingDependencyError
from limber.geometry.generated import generate_branch
from limber.store import Branch

_SKELETON = """
import hashlib, sys
import numpy as np
from limber.geometry.skeleton.skeletonise import skeletonise
result = skeletonise(np.load(sys.argv[1]), root=np.zeros(3))
found = result.skeleton
print(hashlib.sha256(found.nodes.tobytes() + found.parent.tobytes()
                     + found.radius.tobytes()).hexdigest(), round(result.noise, 12))
"""
_LIBRARIES = "import numpy, scipy.linalg\nimport cvxopt.cholmod\n"
_KERNEL = "import os\nos.environ['OPENBLAS_CORETYPE'] = 'Nehalem'\nimport numpy, scipy.linalg\n"
_SOLVED = """
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import BranchModel, solve_static
mesh = straight_beam(0.2, 0.01, slice_count=3)
solve_static(BranchModel(mesh, young=1e8, poisson=0.3, density=900.0)).require()
"""
_POOLS = """
from threadpoolctl import threadpool_info
pools = [pool for pool in threadpool_info() if pool["user_api"] in ("blas", "openmp")]
assert len(pools) >= 2 and {pool["num_threads"] for pool in pools} == {1}, pools
"""


def _told(program: str, threads: int, *arguments: str) -> str:
    """What a program prints where the user's environment asks for so many threads."""
    environment = os.environ | {"OMP_NUM_THREADS": str(threads),
                                "OPENBLAS_NUM_THREADS": str(threads)}
    done = subprocess.run([sys.executable, "-c", program, *arguments], check=False,
                          capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(("points", "before"), [
    (lambda: curved_leaves(2800)[0], _LIBRARIES + _SOLVED + _POOLS),
    (lambda: sparse_case(3, "dichotomous", "round").points, _KERNEL)])
def test_a_scan_has_one_skeleton_whatever_was_loaded_before(tmp_path, points, before) -> None:
    """A leafy one with one thread, and with four in libraries loaded first and after a solve; a
    thin one with the kernels of another processor in all libraries: to the last bit.

    Leaves lead a fit astray: one more thread had made another skeleton, or a refusal. After a
    static solve all libraries of the process, cvxopt's too, use one thread.
    """
    np.save(scan := tmp_path / "scan.npy", points())
    assert _told(before + _SKELETON, 4, str(scan)) == _told(_SKELETON, 1, str(scan))


@pytest.mark.slow
def test_another_processor_writes_the_same_bytes(tmp_path):
    """Sums in another order, without wide vectors and fused multiplication: of a branch folder only
    times, memory and its own name differ."""
    scan = tmp_path / "scan.ply"
    generate_branch(3, fork_count=2, length=0.4, point_spacing=0.0025).cloud.write_ply(scan)
    found = []
    for kernel, without in (("Haswell", ""), ("Nehalem", "AVX2 FMA3 AVX512F AVX512CD AVX512_SKX")):
        folder = tmp_path / f"{kernel}.branch"
        subprocess.run(
            [sys.executable, "-m", "limber", "reconstruct", scan, "-o", folder], check=True,
            env=os.environ | {"OPENBLAS_CORETYPE": kernel, "NPY_DISABLE_CPU_FEATURES": without})
        kept = Branch.read(folder).manifest
        del kept.stages["reconstruct"].result["peak_memory_mb"]
        found.append((kept.files, kept.stages["reconstruct"].result))
    assert found[0] == found[1] and {"cloud.ply", "skeleton.swc", "mesh.vtu"} < set(found[0][0])


def test_contraction_is_the_same_on_every_processor(tmp_path) -> None:
    """With an old processor's kernels in all libraries: to the last bit."""
    np.save(scan := tmp_path / "scan.npy", sparse_case(3, "dichotomous", "round").points)
    contracted = ("import sys, numpy as np, limber.geometry.skeleton.contraction as own\n"
                  "print(own.contract(np.load(sys.argv[1])).points.tobytes().hex())")
    assert _told(_KERNEL + contracted, 1, str(scan)) == _told(contracted, 1, str(scan))


@pytest.mark.parametrize("before", ["", "import numpy, scipy.linalg\n", _LIBRARIES])
def test_limber_leaves_no_library_with_two_threads(before: str) -> None:
    """Whatever the environment says, and whichever was loaded before it or is after."""
    _told(before + "import limber, numpy, scipy.linalg, cvxopt.cholmod\n" + _POOLS, 2)


# The advice how to install what is missing.

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


@pytest.mark.parametrize("prefix, advice", [
    ("", f"Install with `{PIP} -e {shlex.quote(f'{CHECKOUT}[report]')}`."),
    (".venv", f"Run `{shlex.quote(f'{CHECKOUT}/scripts/setup')} --with report`.")])
def test_in_a_checkout_the_advice_names_the_checkout(monkeypatch, prefix, advice):
    """With the Python at hand, not with that of the PATH; in .venv by what made that."""
    monkeypatch.setattr(sys, "prefix", str(CHECKOUT / prefix))
    with pytest.raises(MissingDependencyError) as caught:
        optional.require_extra("report", ("no_such_package",), "The report")
    assert str(caught.value) == (f"no_such_package is not installed. The report needs it. {advice}")


@pytest.mark.parametrize("extra", ["planning", "robot", "blender"])
def test_an_extra_without_a_wheel_is_said_by_its_python(monkeypatch, extra):
    """Which ones lack, the markers of pyproject.toml say as well."""
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    for minor in range(11, 15):
        monkeypatch.setattr(sys, "version_info", SimpleNamespace(minor=minor))
        there = {"python_version": f"3.{minor}", "sys_platform": "linux"}
        has = any(Requirement(need).marker.evaluate(there)
                  for need in project["optional-dependencies"][extra])
        assert has == ("no wheel" not in optional.how_to_install(extra))
