"""One thread in every library, and results that do not depend on how many there were."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.subjects.leafy import curved_leaves

_SKELETON = """
import hashlib, sys
import numpy as np
from limber.geometry.skeleton.skeletonise import skeletonise
result = skeletonise(np.load(sys.argv[1]), root=np.zeros(3))
found = result.skeleton
print(hashlib.sha256(found.nodes.tobytes() + found.parent.tobytes()
                     + found.radius.tobytes()).hexdigest(), result.noise)
"""
_LIBRARIES = "import numpy, scipy.linalg\nimport cvxopt.cholmod\n"
_SOLVED = """
from limber.geometry.tets.cylinder_mesh import straight_beam
from limber.mechanics import BranchModel, solve_static
mesh = straight_beam(0.2, 0.01, slice_count=3)
solve_static(BranchModel(mesh, young=1e8, poisson=0.3, density=900.0)).require()
"""


@pytest.mark.slow
def test_a_leafy_scan_has_one_skeleton_whatever_threads_the_user_has(tmp_path: Path) -> None:
    """With 1, 2 and 4 threads, also of libraries loaded first, and after a solve: to the last bit.

    Leaves lead a fit astray: one more thread had made another skeleton, or a refusal.
    """
    scan = tmp_path / "scan.npy"
    np.save(scan, curved_leaves()[0])
    skeletons = {}
    for name, threads, before in (("one", 1, ""), ("two, loaded", 2, _LIBRARIES),
                                  ("four, solved", 4, _LIBRARIES + _SOLVED)):
        environment = os.environ | {"OMP_NUM_THREADS": str(threads),
                                    "OPENBLAS_NUM_THREADS": str(threads)}
        done = subprocess.run([sys.executable, "-c", before + _SKELETON, str(scan)], check=False,
                              capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        skeletons[name] = done.stdout
    assert len(set(skeletons.values())) == 1, skeletons


@pytest.mark.parametrize("before", ["", "import numpy, scipy.linalg\n"])
def test_limber_leaves_no_library_with_two_threads(before: str) -> None:
    """Whatever the environment says, and whichever was loaded before it or is after."""
    program = before + (
        "import limber, numpy, scipy.linalg, cvxopt.cholmod\n"
        "from threadpoolctl import threadpool_info\n"
        "pools = [p for p in threadpool_info() if p['user_api'] in ('blas', 'openmp')]\n"
        "assert len(pools) >= 2 and {p['num_threads'] for p in pools} == {1}, pools\n")
    environment = os.environ | {"OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True,
                          text=True, env=environment)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_factorisation_leaves_every_library_with_one_thread():
    """After a static solve all BLAS libraries of the process, cvxopt's too, use one thread."""
    program = (
        "from limber.geometry.tets.cylinder_mesh import straight_beam\n"
        "from limber.mechanics import BranchModel, solve_static\n"
        "mesh = straight_beam(0.2, 0.01, slice_count=3)\n"
        "solve_static(BranchModel(mesh, young=1e8, poisson=0.3, density=900.0)).require()\n"
        "from threadpoolctl import threadpool_info\n"
        "pools = [p for p in threadpool_info() if p['user_api'] == 'blas']\n"
        "assert len(pools) >= 2, pools\n"
        "assert {p['num_threads'] for p in pools} == {1}, pools\n")
    done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True,
                          text=True)
    assert done.returncode == 0, done.stderr
