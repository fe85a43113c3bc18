"""The stage ``simulate``: a pull or a force on a branch over time, as frames and numbers."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from limber.errors import ConvergenceError, InputError
from limber.geometry.skeleton import Skeleton
from limber.geometry.tet_mesh import TetMesh
from limber.mechanics.dynamics import DynamicResult, simulate_dynamics
from limber.mechanics.frames import surface_vertices, write_pc2, write_pvd_series
from limber.mechanics.grasp import Grasp
from limber.mechanics.materials import RayleighDamping
from limber.mechanics.model import BranchModel
from limber.mechanics.statics import StaticResult, follow_poses, solve_static
from limber.mechanics.strain import strain_state
from limber.progress import SILENT, Progress
from limber.store import Branch, Stage, plain

# Of the way from base to grasp: a pull that any branch takes when none is asked for.
_DEFAULT_PULL = 0.15


class SimulateSettings(BaseModel):
    """How a branch is moved. Without ``pull`` and ``load`` it is pulled a little sideways."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field("pull", pattern=r"^[\w.-]+$", description="Name of the frames' files.")
    motion: Literal["dynamic", "static"] = Field(
        "dynamic", description="dynamic: Newmark in time; static: equilibria along the way.")
    pull: tuple[float, float, float] | None = Field(
        None, description="Move the grasp by X Y Z [m] from where it rests.")
    turn: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="Turn the clamped grasp by a rotation vector [rad] as well.")
    load: tuple[float, float, float] | None = Field(
        None, description="Force X Y Z [N] on the grasp patch, instead of a pull.")
    grasp: Literal["clamped", "pinned"] = Field(
        "pinned", description="clamped: the gripper turns the branch; pinned: it may turn freely.")
    duration: float = Field(2.0, gt=0, description="Time of the pull or of the load's rise [s].")
    hold: float = Field(0.5, ge=0, description="Time after that [s]; dynamic motion only.")
    frame_rate: float = Field(24.0, gt=0, le=1000, description="Frames a second.")
    gravity: bool = Field(True, description="Let the branch bear its own weight.")
    damping_mass: float = Field(0.5, ge=0, description="Rayleigh damping of the mass [1/s].")
    damping_stiffness: float = Field(
        0.002, ge=0, description="Rayleigh damping of the stiffness [s].")
    series: bool = Field(False, description="Also write a VTU series that ParaView opens.")


@dataclass(frozen=True)
class Motion:
    """What both kinds of motion give; arrays by frame.

    Attributes:
        times: [s].
        displacement: [m], shape [frames, node_count, 3].
        strain_energy: [J].
        grasp_force: [N], shape [frames, 3].
        min_det_f: Smallest determinant of the deformation gradient.
        warnings: What a user should know.
    """

    times: np.ndarray
    displacement: np.ndarray
    strain_energy: np.ndarray
    grasp_force: np.ndarray
    min_det_f: np.ndarray
    warnings: list[str]


def simulate_branch(folder: Path, settings: SimulateSettings, *, force: bool = False,
                    progress: Progress = SILENT, warn: Callable[[str], None] = lambda _: None,
                    ) -> dict[str, Any]:
    """Move the branch of a folder and write ``frames/NAME.pc2`` and ``frames/NAME.json``.

    Raises:
        ConvergenceError: the branch cannot follow; the message has how far it came, the place and
            the reason. Nothing is written then.
    """
    branch = Branch.open(folder)
    mesh = TetMesh.read(branch.require("mesh.vtu", "reconstruct"))
    key, reads = f"simulate:{settings.name}", ["mesh.vtu"]
    if not force and branch.is_current(key, settings, reads=reads):
        return branch.manifest.stages[key].result
    with branch.stage(key, settings, reads=reads) as stage:
        model = _model(branch, settings)
        motion = _move(model, settings, _reach(mesh), progress)
        for warning in motion.warnings:
            warn(warning)
        _write(stage, settings, model, motion)
        tip = _tip(branch, mesh)
        stage.result.update(
            converged=True, frame_count=len(motion.times), energy_j=motion.strain_energy[-1],
            energy_max_j=motion.strain_energy.max(), grasp_force_n=motion.grasp_force[-1],
            tip_displacement_m=motion.displacement[-1, tip], min_det_f=motion.min_det_f.min())
    return branch.manifest.stages[key].result


def _model(branch: Branch, settings: SimulateSettings) -> BranchModel:
    overrides: dict[str, Any] = {} if settings.gravity else {"gravity": None}
    damping = RayleighDamping(settings.damping_mass, settings.damping_stiffness)
    return BranchModel.from_branch(branch, damping=damping, **overrides)


def _move(model: BranchModel, settings: SimulateSettings, reach: float,
          progress: Progress) -> Motion:
    if settings.pull is not None and settings.load is not None:
        raise InputError("Both --pull and --load were given.",
                         "A gripper's position and its force cannot both be prescribed.",
                         "Give one of them.")
    grasp = Grasp.from_mesh(model.mesh, settings.grasp)
    rest = solve_static(model).require()
    times = _times(settings)
    # Half a cosine: starts and ends without a jolt.
    rise = 0.5 - 0.5 * np.cos(np.pi * np.minimum(times / settings.duration, 1.0))
    driven: dict[str, np.ndarray] = {}
    if settings.load is not None:
        driven["grasp_forces"] = rise[:, None] * np.array(settings.load)
    else:
        begin = grasp.pose_of(model.mesh.nodes, rest.displacement)
        pull = settings.pull or (_DEFAULT_PULL * reach, 0.0, 0.0)
        driven["poses"] = begin + rise[:, None] * np.concatenate([pull, settings.turn])
    if settings.motion == "static":
        return _static(model, grasp, times, rest, driven, progress)
    result = simulate_dynamics(model, grasp=grasp, times=times, start=rest, progress=progress,
                               **driven)
    return _dynamic(result.require())


def _times(settings: SimulateSettings) -> np.ndarray:
    end = settings.duration + (settings.hold if settings.motion == "dynamic" else 0.0)
    return np.linspace(0.0, end, max(2, round(end * settings.frame_rate) + 1))


def _dynamic(result: DynamicResult) -> Motion:
    return Motion(result.times, result.displacement, result.strain_energy, result.reaction_force,
                  result.min_det_f, result.warnings)


def _static(model: BranchModel, grasp: Grasp, times: np.ndarray, rest: StaticResult,
            driven: dict[str, np.ndarray], progress: Progress) -> Motion:
    if "poses" in driven:
        states = follow_poses(model, grasp, driven["poses"], start=rest, progress=progress)
    else:
        states = _follow_forces(model, grasp, driven["grasp_forces"], rest, progress)
    for number, state in enumerate(states):
        if not state.converged:
            before = max(number - 1, 0)
            raise ConvergenceError(
                f"The branch cannot follow beyond frame {before} of {len(states) - 1} "
                f"({100 * before / (len(states) - 1):.0f} % of the way): {state.message}",
                f"Status: {state.status}.",
                "Pull less far, or check Young's modulus and units.", result=state)
    forces = driven.get("grasp_forces", np.array([state.reaction_force for state in states]))
    return Motion(
        times, np.array([state.displacement for state in states]),
        np.array([state.strain_energy for state in states]), forces,
        np.array([state.min_det_f for state in states]),
        sorted({warning for state in states for warning in state.warnings}))


def _follow_forces(model: BranchModel, grasp: Grasp, forces: np.ndarray, rest: StaticResult,
                   progress: Progress) -> list[StaticResult]:
    states, last = [], rest
    for number, grasp_force in enumerate(forces):
        progress(number / len(forces), "following forces", frame=number)
        state = solve_static(model, grasp=grasp, grasp_force=grasp_force, start=last)
        states.append(state)
        if not state.converged:
            break
        last = state
    return states


def _write(stage: Stage, settings: SimulateSettings, model: BranchModel, motion: Motion) -> None:
    from limber.scene_data import at_nodes

    mesh = model.mesh
    nodes, _ = surface_vertices(mesh)
    frames = mesh.nodes[nodes] + motion.displacement[:, nodes]
    base = f"frames/{settings.name}"
    write_pc2(stage.path(f"{base}.pc2"), frames, 0.0, 1.0)
    stage.path(f"{base}.json").write_text(json.dumps(plain({
        "frame_count": len(motion.times), "rate": settings.frame_rate,
        "vertex_count": len(nodes), "times_s": motion.times, "energies_j": motion.strain_energy,
        "forces_n": motion.grasp_force, "min_det_f": motion.min_det_f}), allow_nan=False) + "\n",
        encoding="utf-8")
    density = [strain_state(model, u).energy_density for u in motion.displacement]
    np.savez_compressed(
        stage.path(f"{base}.npz"), strain_energy_density_j_m3=np.array(
            [at_nodes(mesh, values)[nodes] for values in density], np.float32))
    if settings.series:
        write_pvd_series(stage.path(f"frames/{settings.name}-series/{settings.name}.pvd"), mesh,
                         motion.times, motion.displacement,
                         {"strain_energy_density": np.array(density)})


def _reach(mesh: TetMesh) -> float:
    """Distance [m] from the fixed base to the grasp."""
    base = mesh.nodes[np.asarray(mesh.point_data["fixed"], bool)].mean(axis=0)
    return float(np.linalg.norm(Grasp.from_mesh(mesh).centre - base))


def _tip(branch: Branch, mesh: TetMesh) -> int:
    """Node nearest the tip of the main path; without a skeleton the one farthest from the base."""
    if branch.has("skeleton.swc"):
        skeleton = Skeleton.read_swc(branch.path("skeleton.swc"))
        target = skeleton.nodes[skeleton.main_path()[-1]]
        return int(np.linalg.norm(mesh.nodes - target, axis=1).argmin())
    base = mesh.nodes[np.asarray(mesh.point_data["fixed"], bool)].mean(axis=0)
    return int(np.linalg.norm(mesh.nodes - base, axis=1).argmax())
