"""The stage `simulate`: pull a branch by a pose or a force, in balance or in time."""

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from limber.errors import ConvergenceError, InputError
from limber.mechanics.dynamics import NewmarkSettings, simulate_dynamics
from limber.mechanics.frames import surface_nodes, write_pc2, write_pvd_series
from limber.mechanics.grasp import Grasp
from limber.mechanics.materials import RayleighDamping
from limber.mechanics.model import BranchModel
from limber.mechanics.rest_shape import unloaded_rest_shape
from limber.mechanics.statics import StaticResult, follow_poses, solve_static
from limber.mechanics.strain import strain_state
from limber.progress import SILENT, Progress
from limber.store import Branch, write_atomically

STAGE = "simulate"

_PROBE = 1e-6
# Of the way from base to grasp: how far a branch is bent when nothing is asked for.
_DEFAULT_BEND = 0.2


class SimulateSettings(BaseModel):
    """Options of `limber simulate`; with no motion and no force, one that bends it a little."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field("simulate", pattern=r"^[\w-]+$",
                      description="Name of the result: frames/NAME.pc2 and frames/NAME.json.")
    kind: Literal["static", "dynamic"] = Field(
        "dynamic", description="dynamic: motion in time; static: a path of equilibria.")
    move: tuple[float, float, float] | None = Field(
        None, description="Move the grasp by X Y Z [m].")
    turn: tuple[float, float, float] | None = Field(
        None, description="Turn the grasp by a rotation vector X Y Z [rad].")
    grasp_force: tuple[float, float, float] | None = Field(
        None, description="Pull the grasp with a force X Y Z [N] instead of moving it.")
    grasp_point: tuple[float, float, float] | None = Field(
        None, description="Grasp at X Y Z [m] instead of where the mesh marks it.")
    grasp_radius: float = Field(0.01, gt=0, description="Radius of that grasp [m].")
    grasp_mode: Literal["clamped", "pinned"] = Field(
        "clamped", description="clamped: position and rotation held; pinned: position alone.")
    duration: float = Field(1.0, gt=0, description="Time of the pull [s].")
    hold: float = Field(0.5, ge=0, description="Time at the end of the pull [s] (dynamic).")
    frame_rate: float = Field(60.0, gt=0, le=2000, description="Frames a second.")
    step: float = Field(1 / 60, gt=0, description="Longest time step [s] (dynamic).")
    gravity: bool = Field(True, description="Gravity, as it acts on the scan.")
    rest_shape: bool = Field(
        True, description="Take the scan as already sagging under gravity.")
    material: Literal["st_venant_kirchhoff", "stable_neo_hookean", "linear"] = Field(
        "st_venant_kirchhoff", description="Material law.")
    damping_mass: float = Field(0.5, ge=0, description="Damping on velocity [1/s].")
    damping_stiffness: float = Field(0.002, ge=0, description="Damping on strain rate [s].")
    vtu: bool = Field(False, description="Also write a VTU series that ParaView opens.")


def simulate(branch_folder: str | Path, settings: SimulateSettings, *,
             force: bool = False, progress: Progress = SILENT,
             warn: Any = lambda _message: None) -> dict[str, Any]:
    """Pull the branch of a folder; write ``frames/NAME.pc2`` and ``frames/NAME.json``.

    Returns:
        The keys of the design's table: ``converged``, ``frame_count``, ``energy_j``,
        ``grasp_force_n``, ``tip_displacement_m``, ``min_det_f``.

    Raises:
        InputError: options that do not fit. ConvergenceError: the branch could not follow; the
            frames up to there are written.
    """
    branch = Branch.open(branch_folder)
    branch.require("mesh.vtu", "reconstruct")
    if settings.grasp_force is not None and (settings.move or settings.turn):
        raise InputError("Both a motion and a force were given.",
                         "A grasp follows a pose or takes a force.",
                         "Give --move and --turn, or --grasp-force.")
    stored = branch.manifest.stages.get(STAGE)
    if not force and stored and stored.result.get("converged") and branch.is_current(
            STAGE, settings, reads=["mesh.vtu"]):
        return stored.result
    model, grasp = _prepared(branch, settings, progress.part(0.0, 0.2), warn)
    run = _static if settings.kind == "static" else _dynamic
    driven = settings
    if settings.move is None and settings.turn is None and settings.grasp_force is None:
        driven = settings.model_copy(update={"grasp_force": bending_force(model, grasp)})
    motion = run(model, grasp, driven, progress.part(0.2, 0.9))
    for message in motion["warnings"]:
        warn(message)
    with branch.stage(STAGE, settings, reads=["mesh.vtu"]) as stage:
        result = _write(stage, model, settings, motion)
        stage.result.update(result)
    progress(1.0, "done")
    if not motion["converged"]:
        raise ConvergenceError(
            f"The branch could not follow: {motion['message']}",
            f"{result['frame_count']} frames up to the last good state are in"
            f" frames/{settings.name}.pc2; there the grasp force is {result['grasp_force_n']} N.",
            "Pull less far, or check units and Young's modulus.")
    return result


def bending_force(model: BranchModel, grasp: Grasp) -> tuple[float, float, float]:
    """Return the force [N] across the branch that would bend it by a fifth of its reach.

    By the stiffness at rest. A motion along a line invented in space would buckle or stretch a
    branch, whose length is fixed; under a force it goes where it can.
    """
    axis = grasp.centre - model.mesh.nodes[model.fixed].mean(axis=0)
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    weightless = model.with_parameters(gravity=(0.0, 0.0, 0.0))
    probe = solve_static(weightless, grasp=grasp, grasp_force=_PROBE * across).require()
    moved = np.linalg.norm(grasp.weights @ probe.displacement[grasp.nodes])
    x, y, z = _PROBE * _DEFAULT_BEND * np.linalg.norm(axis) / moved * across
    return float(x), float(y), float(z)


def _prepared(branch: Branch, settings: SimulateSettings, progress: Progress,
              warn: Any) -> tuple[BranchModel, Grasp]:
    progress(0.0, "preparing")
    model = BranchModel.from_branch(
        branch, material=settings.material, gravity=branch.gravity if settings.gravity else None,
        damping=RayleighDamping(settings.damping_mass, settings.damping_stiffness))
    if settings.gravity and settings.rest_shape:
        try:
            mesh = unloaded_rest_shape(model, progress=progress)
            model = model.with_rest_nodes(mesh.nodes)
        except ConvergenceError as error:
            warn(f"{error} The scan is taken as the shape without load.")
    if settings.grasp_point is None:
        return model, Grasp.from_mesh(model.mesh, settings.grasp_mode)
    return model, Grasp.at(model.mesh, np.array(settings.grasp_point), settings.grasp_radius,
                           settings.grasp_mode)


def _ramp(settings: SimulateSettings, hold: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and the part of the pull at each, starting and ending at rest."""
    count = max(2, round((settings.duration + hold) * settings.frame_rate) + 1)
    times = np.arange(count) / settings.frame_rate
    part = np.clip(times / settings.duration, 0, 1)
    return times, part**2 * (3 - 2 * part)


def _way(start: StaticResult, grasp: Grasp, settings: SimulateSettings,
         part: np.ndarray) -> np.ndarray:
    """Return the grasp's poses [frames, 6], from where the loaded branch holds it."""
    pose = start.pose if start.pose is not None else grasp.rest_pose
    change = np.concatenate([settings.move or (0.0, 0, 0), settings.turn or (0.0, 0, 0)])
    if settings.grasp_mode == "pinned":
        pose = np.concatenate([pose[:3], np.zeros(3)])
    return _composed(pose, part[:, None] * change)


def _composed(pose: np.ndarray, changes: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_rotvec(changes[:, 3:]) * Rotation.from_rotvec(pose[3:])
    return np.hstack([pose[:3] + changes[:, :3], turned.as_rotvec()])


def _static(model: BranchModel, grasp: Grasp, settings: SimulateSettings,
            progress: Progress) -> dict[str, Any]:
    times, _ = _ramp(settings, 0.0)
    part = np.clip(times / settings.duration, 0, 1)
    start = solve_static(model, grasp=grasp, grasp_force=np.zeros(3)).require()
    if settings.grasp_force is None:
        results = follow_poses(model, grasp, _way(start, grasp, settings, part), start=start,
                               progress=progress)
    else:
        results = [start]
        for number, share in enumerate(part[1:]):
            progress(number / len(part), "following the force")
            results.append(solve_static(
                model, grasp=grasp, grasp_force=share * np.array(settings.grasp_force),
                start=results[-1]))
            if not results[-1].converged:
                break
    good = [r for r in results if r.converged]
    bad = next((r for r in results if not r.converged), None)
    if bad is not None:
        good = results[:results.index(bad)] + [bad]
    force = [result.reaction_force for result in good]
    if settings.grasp_force is not None:
        force = part[:len(good), None] * np.array(settings.grasp_force)
    return {
        "times": times[:len(good)], "displacement": np.array([r.displacement for r in good]),
        "strain_energy": [r.strain_energy for r in good], "kinetic_energy": [0.0] * len(good),
        "grasp_force": np.array(force), "grasp_torque": [r.reaction_torque for r in good],
        "min_det_f": [r.min_det_f for r in good], "converged": bad is None,
        "message": "" if bad is None else bad.message, "warnings": good[-1].warnings}


def _dynamic(model: BranchModel, grasp: Grasp, settings: SimulateSettings,
             progress: Progress) -> dict[str, Any]:
    times, part = _ramp(settings, settings.hold)
    newmark = NewmarkSettings(max_step=settings.step)
    start = solve_static(model, grasp=grasp, grasp_force=np.zeros(3)).require()
    if settings.grasp_force is None:
        found = simulate_dynamics(model, grasp=grasp, poses=_way(start, grasp, settings, part),
                                  times=times, start=start, settings=newmark, progress=progress)
        force = found.reaction_force
    else:
        pull = part[:, None] * np.array(settings.grasp_force)
        found = simulate_dynamics(model, grasp=grasp, grasp_forces=pull, times=times, start=start,
                                  settings=newmark, progress=progress)
        force = pull[:len(found.times)]
    return {
        "times": found.times, "displacement": found.displacement,
        "strain_energy": found.strain_energy, "kinetic_energy": found.kinetic_energy,
        "grasp_force": force, "grasp_torque": found.reaction_torque,
        "min_det_f": found.min_det_f, "converged": found.converged, "message": found.message,
        "warnings": found.warnings}


def _write(stage: Any, model: BranchModel, settings: SimulateSettings,
           motion: dict[str, Any]) -> dict[str, Any]:
    displacement = motion["displacement"]
    nodes = surface_nodes(model.mesh)
    write_pc2(stage.path(f"frames/{settings.name}.pc2"),
              model.mesh.nodes[nodes] + displacement[:, nodes])
    if settings.vtu:
        folder = stage.path(f"frames/{settings.name}/{settings.name}.pvd").parent
        write_pvd_series(folder, settings.name, model, motion["times"], displacement)
    tip = int(np.linalg.norm(model.mesh.nodes - model.mesh.nodes[model.fixed].mean(axis=0),
                             axis=1).argmax())
    strain, stress = _largest(model, displacement)
    rows = {name: np.asarray(motion[name]).tolist()
            for name in ("times", "strain_energy", "kinetic_energy", "grasp_force",
                         "grasp_torque", "min_det_f")}
    frames = {
        "frame_count": len(displacement), "rate": settings.frame_rate,
        "times_s": rows["times"], "energies_j": rows["strain_energy"],
        "kinetic_energies_j": rows["kinetic_energy"], "grasp_forces_n": rows["grasp_force"],
        "grasp_torques_nm": rows["grasp_torque"], "min_det_f": rows["min_det_f"],
        "converged": motion["converged"],
        "largest_principal_strains": strain, "largest_principal_stresses_pa": stress}
    write_atomically(stage.path(f"frames/{settings.name}.json"), json.dumps(frames, indent=1))
    return {
        "converged": motion["converged"], "frame_count": len(displacement),
        "energy_j": rows["strain_energy"][-1], "grasp_force_n": rows["grasp_force"][-1],
        "tip_displacement_m": (displacement[-1, tip] - displacement[0, tip]).tolist(),
        "min_det_f": float(np.min(rows["min_det_f"]))}


def _largest(model: BranchModel, displacement: np.ndarray) -> tuple[list[float], list[float]]:
    """Return the largest principal strain and stress [Pa] of each frame."""
    states = [strain_state(model, frame) for frame in displacement]
    return ([float(s.principal_strain[:, -1].max()) for s in states],
            [float(s.principal_stress[:, -1].max()) for s in states])
