"""Runs another program on clouds, in an environment of its own, which has no Limber.

``python peer_programs.py PROGRAM FOLDER``: for each ``NAME.npy``, points [m], shape [n, 3], the
root lowest, it writes ``NAME.npz``: axes as segments [m], shape [k, 2, 3], radii [m], shape [k]
(NaN if the program has none), and the processor time [s]; or ``NAME.txt``, why not.
"""

import ctypes
import signal
import sys
import time
from pathlib import Path

import numpy as np


def pytlidar(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """TreeQSM in Python, with the inputs that it estimates itself."""
    from PyTLidar import build_inputs, run_qsm

    inputs, = build_inputs([points], savetxt=0, savepdf=0)
    cylinder = run_qsm(points, inputs)[0][0]["cylinder"]
    start, axis, length, radius = (np.asarray(cylinder[name], float) for name in (
        "start", "axis", "length", "radius"))
    return np.stack([start, start + axis * length.reshape(-1, 1)], axis=1), radius.ravel()


def pc_skeletor(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Laplacian-based contraction with its defaults."""
    import libusb_package

    # Open3D's wheel is linked to it and does not bring it.
    ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)
    import open3d
    from pc_skeletor import LBC

    contraction = LBC(open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)))
    contraction.extract_skeleton()
    contraction.extract_topology()
    graph = contraction.skeleton_graph
    places = np.array([graph.nodes[node]["pos"] for node in range(graph.number_of_nodes())])
    segments = places[np.array(graph.edges())]
    return segments, np.full(len(segments), np.nan)


PROGRAMS = {"PyTLidar": pytlidar, "PC-skeletor": pc_skeletor}
MOST_S = 60
"""Time of one cloud [s]."""


def run(name: str, folder: Path) -> None:
    """Run a program on all clouds of a folder."""
    files = sorted(folder.glob("*.npy"))
    for file in [files[0], *files]:  # the first once more: it was compiled with it
        signal.alarm(MOST_S)
        began = time.process_time()
        try:
            segments, radii = PROGRAMS[name](np.load(file))
            np.savez(file.with_suffix(".npz"), segments=segments, radii=radii,
                     seconds=time.process_time() - began)
        except Exception as error:
            file.with_suffix(".txt").write_text(f"{type(error).__name__}: {error}")
        signal.alarm(0)


def _late(_signal: int, _frame: object) -> None:
    raise TimeoutError(f"not done after {MOST_S} s")


if __name__ == "__main__":
    signal.signal(signal.SIGALRM, _late)
    run(sys.argv[1], Path(sys.argv[2]))
