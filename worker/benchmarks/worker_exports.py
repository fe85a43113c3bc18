"""Exported branches in their target programs, bent and swung, compared with our own elements."""

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import eigh

from benchmarks.table import Asked, Row, Setting
from limber.core.progress import SILENT
from limber.geometry.generated import generate_branch
from limber.geometry.reconstruction import mesh_skeleton
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.skeleton import Skeleton
from limber.mechanics.dynamics.modes import lowest_modes
from limber.mechanics.model import DEFAULT_DAMPING, BranchModel
from limber.mechanics.statics.solve import solve_static
from limber.results.exports.abaqus import inp_text
from limber.results.exports.mjcf import mjcf_text
from limber.results.exports.rigid_links import matched, rod_tree
from limber.results.exports.usd import as_deformable

_LINKS = 30
_SHARE = 0.01
"""Approximate bending of the tip, as a fraction of the main path's length."""


@dataclass(frozen=True)
class Bent:
    """Result of one program: tip's displacement [m], shape [3], and first frequency [Hz]."""

    tip: np.ndarray
    frequency: float


_PROGRAMS = ("MuJoCo, weightless", "MuJoCo, hanging", "USD (its mesh and modulus by our solver)",
             "CalculiX, weightless")
EXPORT_ROWS = tuple(Asked(f"export in {label}, worst: static tip; first frequency", "2 %; 2 %")
                    for label in _PROGRAMS)


def exported(setting: Setting) -> list[Row]:
    """Generated branches, weightless and hanging, in MuJoCo; weightless in CalculiX."""
    trials = setting.trials("exports", setting.seeds(20, 2), _bent, "results", "mechanics",
                            "geometry")
    found = {label: [each[label] for each in trials if label in each.values]
             for label in _PROGRAMS}
    return [_row(asked, found[label]) if found[label] else
            Row(*asked, "the program is not installed", None, 0)
            for asked, label in zip(EXPORT_ROWS, _PROGRAMS, strict=True)]


def _bent(seed: int) -> dict[str, tuple[float, float]]:
    """Difference of each program from our elements, for one generated branch."""
    found = {}
    branch = generate_branch(seed)
    mesh = mesh_skeleton(branch.skeleton, ReconstructSettings(), SILENT).mesh
    mujoco_still, mujoco_hanging, usd, calculix = _PROGRAMS
    for label, gravity in ((mujoco_still, None), (mujoco_hanging, (0, 0, -9.81))):
        model = BranchModel(mesh, young=1e9, poisson=0.35, density=800.0, gravity=gravity)
        model = model.as_scanned() if gravity else model
        node, load = _load(model, branch.skeleton)
        bent = {label: bent_in_mujoco(model, branch.skeleton, mesh.nodes[node], load)}
        if gravity is None:
            bent |= {usd: bent_as_usd(model, node, load),
                     calculix: bent_in_calculix(model, node, load)}
        ours = bent_here(model, node, load)
        found |= {name: _apart(ours, theirs) for name, theirs in bent.items() if theirs}
    return found


def _row(asked: Asked, errors: list[tuple[float, float]]) -> Row:
    tip, frequency = np.max(np.array(errors, float), axis=0)
    return Row(*asked, f"{100 * tip:.2f} %; {100 * frequency:.2f} %",
               bool(tip <= 0.02 and frequency <= 0.02), len(errors))


def _apart(ours: Bent, theirs: Bent) -> tuple[float, float]:
    return (float(np.linalg.norm(theirs.tip - ours.tip) / np.linalg.norm(ours.tip)),
            abs(theirs.frequency / ours.frequency - 1))


def _load(model: BranchModel, skeleton: Skeleton) -> tuple[int, np.ndarray]:
    """The tip's node and a force across the branch that bends it a little."""
    path = skeleton.main_path()
    node = int(np.linalg.norm(model.mesh.nodes - skeleton.nodes[path[-1]], axis=1).argmin())
    load = np.array([1e-3, 5e-4, 0.0])
    tip = bent_here(model, node, load).tip
    length = float(skeleton.arc_length[path[-1]])
    return node, load * _SHARE * length / float(np.linalg.norm(tip))


def bent_here(model: BranchModel, node: int, load: np.ndarray) -> Bent:
    """Our own quadratic tetrahedra."""
    forces = np.zeros_like(model.mesh.nodes)
    forces[node] = load
    moved = solve_static(model, nodal_forces=forces).require().displacement[node]
    return Bent(moved, float(lowest_modes(model, 1).frequencies[0]))


def bent_as_usd(model: BranchModel, node: int, load: np.ndarray) -> Bent:
    """Content of the USD file, bent here: no program that bends it runs without a GPU."""
    return bent_here(as_deformable(model, node).model, node, load)


def bent_in_mujoco(model: BranchModel, skeleton: Skeleton, tip: np.ndarray, load: np.ndarray,
                   links: int = _LINKS) -> Bent | None:
    """Links on springs; None if MuJoCo is not installed."""
    try:
        import mujoco
    except ImportError:
        return None
    length = float(skeleton.arc_length[skeleton.main_path()[-1]])
    node = int(np.linalg.norm(model.mesh.nodes - tip, axis=1).argmin())
    tree, factor = matched(rod_tree(model, skeleton, length / links), model, node)
    print(f"springs scaled by {factor:.3f}")
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


def bent_in_calculix(model: BranchModel, node: int, load: np.ndarray) -> Bent | None:
    """The same tetrahedra in CalculiX; None if ``ccx`` is not on the PATH."""
    program = shutil.which("ccx")
    if program is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "branch.inp").write_text(inp_text(model, "branch", node, load, 1))
        subprocess.run([program, "branch"], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        lines = Path(folder, "branch.dat").read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if "displacements" in line)
    tip = np.array([float(word) for word in lines[at + 2].split()[1:4]])
    at = next(k for k, line in enumerate(lines) if "E I G E N V A L U E   O U T P U T" in line)
    row = next(line.split() for line in lines[at + 1:] if line.split()[:1] == ["1"])
    return Bent(tip, float(row[3]))
