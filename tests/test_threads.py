"""One thread a solver."""

import subprocess
import sys


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
