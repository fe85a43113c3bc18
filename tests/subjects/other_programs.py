"""A branch bent and swung by our own elements, and in the programs that exports are for."""

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import eigh

from limber.geometry.skeleton.skeleton import Skeleton
from limber.mechanics.dynamics.motion import lowest_modes
from limber.mechanics.model import DEFAULT_DAMPING, BranchModel
from limber.mechanics.statics.solve import solve_static
from limber.results.exports.rigid_links import matched, mjcf_text, rod_tree
from limber.results.exports.volumes import inp_text


@dataclass(frozen=True)
class Bent:
    """Result of one program: tip's displacement [m], shape [3], and first frequency [Hz]."""

    tip: np.ndarray
    frequency: float


def bent_here(model: BranchModel, node: int, load: np.ndarray) -> Bent:
    """Our own quadratic tetrahedra."""
    forces = np.zeros_like(model.mesh.nodes)
    forces[node] = load
    moved = solve_static(model, nodal_forces=forces).require().displacement[node]
    return Bent(moved, float(lowest_modes(model, 1).frequencies[0]))


def bent_in_mujoco(model: BranchModel, skeleton: Skeleton, tip: np.ndarray, load: np.ndarray,
                   links: int) -> Bent:
    """Links on springs."""
    import mujoco

    length = float(skeleton.arc_length[skeleton.main_path()[-1]])
    node = int(np.linalg.norm(model.mesh.nodes - tip, axis=1).argmin())
    tree, _ = matched(rod_tree(model, skeleton, length / links), model, node)
    held = mujoco.MjModel.from_xml_string(
        mjcf_text(tree, DEFAULT_DAMPING, "branch", {"tip": tuple(tip)}))
    data, site, count = mujoco.MjData(held), held.site("tip").id, held.nv
    jacobian = np.zeros((3, count))

    def pull(angles: np.ndarray, force: np.ndarray) -> np.ndarray:
        data.qpos[:], data.qvel[:] = angles, 0.0
        mujoco.mj_forward(held, data)
        mujoco.mj_jacSite(held, data, jacobian, None, site)
        return data.qfrc_passive - data.qfrc_bias + jacobian.T @ force

    nothing, step = np.zeros(3), 1e-6
    pull(np.zeros(count), nothing)
    start, mass = data.site_xpos[site].copy(), np.zeros((count, count))
    mujoco.mj_fullM(held, data, mass)
    stiffness = np.stack([(pull(-step * one, nothing) - pull(step * one, nothing)) / (2 * step)
                          for one in np.eye(count)], axis=1)
    stiffness = (stiffness + stiffness.T) / 2
    angles = np.zeros(count)
    for _ in range(50):
        left = pull(angles, load)
        if np.abs(left).max() < 1e-12:
            break
        angles = angles + np.linalg.solve(stiffness, left)
    square = float(eigh(stiffness, mass, eigvals_only=True, subset_by_index=[0, 0])[0])
    return Bent(data.site_xpos[site] - start, np.sqrt(square) / (2 * np.pi))


def bent_in_calculix(model: BranchModel, node: int, load: np.ndarray) -> Bent:
    """The same tetrahedra in CalculiX."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "branch.inp").write_text(inp_text(model, "branch", node, load, 1))
        subprocess.run([shutil.which("ccx"), "branch"], cwd=folder, check=True,
                       stdout=subprocess.DEVNULL)
        lines = Path(folder, "branch.dat").read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if "displacements" in line)
    tip = np.array([float(word) for word in lines[at + 2].split()[1:4]])
    at = next(k for k, line in enumerate(lines) if "E I G E N V A L U E   O U T P U T" in line)
    row = next(line.split() for line in lines[at + 1:] if line.split()[:1] == ["1"])
    return Bent(tip, float(row[3]))
