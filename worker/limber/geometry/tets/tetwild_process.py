"""fTetWild in a separate process: it is slow, and must not crash or leak memory in ours.

:func:`run_tetwild` starts ``python -m limber.geometry.tets.tetwild_process IN.npz OUT.npz PARENT``.
"""

import importlib.util
import sys
import tempfile
import types
from collections.abc import Callable
from pathlib import Path

import numpy as np

from limber.core.errors import MeshingError, MissingDependencyError, Option, WorkError
from limber.core.not_none import present
from limber.core.processes.child import run_module
from limber.core.processes.end_with_parent import end_by_kernel
from limber.core.processes.process_limits import Limits
from limber.core.progress import SILENT, Progress

_MEMORY_MB = 4000.0


def run_tetwild(vertices: np.ndarray, faces: np.ndarray, *, edge_length: float, epsilon: float,
                stop_energy: float, coarsen: bool, time_limit: float,
                progress: Progress = SILENT) -> tuple[np.ndarray, np.ndarray]:
    """Fill a closed surface by fTetWild (Hu et al. 2020) to ``stop_energy`` (AMIPS, 3 is best):
    nodes [k, 3] [m], and tetrahedra [t, 4] as it orients them, up to ``epsilon`` [m] from the
    surface. Where that is finer than ``edge_length`` [m], so are they; ``coarsen`` merges them.
    MeshingError also over ``time_limit`` [s] of processor time or ``_MEMORY_MB``."""
    if importlib.util.find_spec("pytetwild") is None:
        raise MissingDependencyError("pytetwild (fTetWild) is not installed.", "",
                                     "Install it, or choose ", Option("mesher", "sweep"), ".")

    def waiting(seconds: float) -> None:
        progress(min(seconds / time_limit, 0.99), "fTetWild", seconds=round(seconds, 1))

    with tempfile.TemporaryDirectory(prefix="limber-tetwild-") as folder:
        source, target = Path(folder, "in.npz"), Path(folder, "out.npz")
        np.savez(source, vertices=vertices, faces=faces, edge_length=edge_length,
                 epsilon=epsilon, stop_energy=stop_energy, coarsen=coarsen)
        try:
            # It also writes a file (__tracked_surface.stl) to its working folder.
            code, last = run_module(__name__, [str(source), str(target)], "fTetWild",
                                    Limits(computed_seconds=time_limit,
                                           memory_mb=_MEMORY_MB), folder=Path(folder),
                                    waiting=waiting)
        except WorkError as error:
            raise MeshingError(error.seen, error.why, "Choose ", Option("mesher", "sweep"), ", or "
                               "a coarser mesh.") from error
        if code != 0 or not target.exists():
            raise MeshingError(f"fTetWild ended with code {code} ({last or 'no message'}).",
                               "The surface may be too fine, or may be damaged.",
                               "Choose ", Option("mesher", "sweep"), ", or a coarser mesh.")
        with np.load(target) as result:
            return result["nodes"], result["tets"]


def _load_tetrahedralize() -> Callable:
    """Import pytetwild's numpy interface without pyvista, which only its package file needs."""
    found = importlib.util.find_spec("pytetwild")
    package = types.ModuleType("pytetwild")
    package.__path__ = list(present(found, "package pytetwild").submodule_search_locations or [])
    sys.modules["pytetwild"] = package
    from pytetwild.pytetwild import tetrahedralize

    return tetrahedralize


def _main(source: str, target: str, parent_id: str) -> None:
    end_by_kernel(int(parent_id))
    with np.load(source) as arrays:
        # The wrapper refuses integers for floats and arrays that are not its own.
        nodes, tets = _load_tetrahedralize()(
            np.array(arrays["vertices"], np.float64, order="C"),
            np.array(arrays["faces"], np.int32, order="C"),
            edge_length_abs=float(arrays["edge_length"]), epsilon=float(arrays["epsilon"]) / float(
                np.linalg.norm(np.ptp(arrays["vertices"], axis=0))),
            stop_energy=float(arrays["stop_energy"]), coarsen=bool(arrays["coarsen"]),
            num_threads=1, quiet=True)
    np.savez(target, nodes=nodes, tets=tets)


if __name__ == "__main__":
    _main(*sys.argv[1:])
