"""Stage ``simulate``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from limber.core.errors import Command, ConvergenceError, InputError, Option, Text
from limber.core.progress import SILENT, Progress
from limber.mechanics.settings import FRAME_RATE, GRASP_RADIUS_M, SimulateSettings, SimulateSpec
from limber.stages.result import FORCE, Picture, Result, Vector, frozen, of_files, shown
from limber.stages.stage import About, BranchStage, KeptStage, given
from limber.store import Branch, OpenStage

if TYPE_CHECKING:
    from limber.mechanics.dynamics.drive import PoseTable
    from limber.mechanics.model import BranchModel
    from limber.mechanics.pull_simulation import SimulatedMotion
    from limber.results.report.section import Section


KEY = "simulate"
_MOST_REPLAYED = 120
"""Frames of a recording that is replayed slowly."""


class Simulation(Result):
    """A simulated motion, frame by frame.

    >>> bent = limber.open("a.branch").simulate(move=(0.005, 0, 0), kind="static", duration=0.1)
    >>> bent.positions.shape[::2] == (len(bent.times), 3)
    True
    """

    heading = "Simulated motion: {name}"
    missing = "limber simulate NAME.branch"
    pictures = (Picture("figures.motion", "Strain and kinetic energy, and the force on the grasp, "
                        "over time.", ("times", "energies", "kinetic_energies", "forces")),)
    columns: ClassVar = {"times": "time_s", "energies": "energy_j", "forces": FORCE,
                         "kinetic_energies": "kinetic_energy_j", "strains": "strain"}

    name: str = shown("name", meaning="name of its files")
    frame_count: int = shown("frames", ",")
    energy: float = shown("final energy", ".4g J")
    grasp_force: Vector = shown("final force", ".4g N", of=np.linalg.norm,
                                meaning="final force of the gripper on the branch [N], shape [3]")
    tip_displacement: Vector = shown("final displacement of the tip", ".1f mm", of=np.linalg.norm)
    peak_strain: float = shown("largest strain", ".4g")
    min_det_f: float = shown("smallest det F", ".3f", meaning="smallest det F, a volume ratio")
    converged: bool = shown("converged", meaning="whether the branch followed to the end")
    times: np.ndarray = of_files("[s], shape [n]")
    energies: np.ndarray = of_files("strain energy [J], shape [n]")
    kinetic_energies: np.ndarray = of_files("[J], shape [n]")
    forces: np.ndarray = of_files("forces of the gripper on the branch [N], shape [n, 3]")
    strains: np.ndarray = of_files("largest principal strain in the branch, shape [n]")
    positions: np.ndarray = of_files("positions of the surface's vertices [m], shape [n, vertices, "
                                     "3], single precision")

    def of_folder(self, branch: Branch, key: str) -> dict[str, Any]:
        from limber.results.motion_files import read_frames_file, read_pc2

        name = branch.manifest.stages[key].settings["name"]
        frames = read_frames_file(branch.path(f"frames/{name}.json"))
        return {"name": name, "times": frozen(frames.times_s),
                "energies": frozen(frames.energies_j),
                "kinetic_energies": frozen(frames.kinetic_energies_j),
                "forces": frozen(frames.grasp_forces_n),
                "strains": frozen(frames.largest_principal_strains),
                "positions": read_pc2(branch.path(f"frames/{name}.pc2"))[0]}

    def illustrate(self, section: Section, branch: Branch, key: str) -> None:
        section.title = self.heading.format(name=self.name)
        super().illustrate(section, branch, key)
        if not self.converged:
            section.text.append("The simulation did not converge to the end; the frames stop at "
                                "the last converged state.")
        section.text.append(_peaks_line({
            "young_median_pa": self.values.get("young_median_pa"),
            "peak_strain": float(self.strains.max()),
            "peak_force_n": float(np.linalg.norm(self.forces, axis=1).max())}))


def _peaks_line(result: Mapping[str, Any]) -> str:
    from limber.results.findings import peaks_line

    return peaks_line(result)


class Simulate(SimulateSettings, KeptStage, BranchStage):
    """Simulate a pull by a pose or a force; writes motion, energy and forces."""

    about = About(
        "simulate", 40, Simulation, key=KEY, reads=("mesh.vtu",),
        writes=("frames/{name}.pc2", "frames/{name}.json"),
        found=("{frame_count} frames. At the end the tip has moved by {tip_displacement_m:|m}, the "
               "force on the grasp is {grasp_force_n:|N} and the branch stores {energy_j:J}.",
               _peaks_line),
        then="limber scene {branch_folder} -o scene.blend --motion {name}", step="material",
        label="Simulate a Motion")

    along: Path | None = given(
        "Table of poses that the grasp follows, relative to its position: a recording's robot.csv, "
        "or a plan's plans/NAME.csv over --duration.", group="motion", metavar="FILE")
    pull: str | None = given(
        "Replay this recording: the grasp, the motion and the result's name are those of the "
        "recording. The measured motion can then be compared frame by frame.", group="motion",
        metavar="NAME", panel=False)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Pull the branch of a folder; write ``frames/NAME.pc2`` and ``frames/NAME.json``.

        Returns:
            The keys of the design's table: ``converged``, ``frame_count``, ``energy_j``,
            ``grasp_force_n``, ``tip_displacement_m``, ``min_det_f``.

        Raises:
            InputError: the options do not fit together, or there is no such recording.
            ConvergenceError: the simulation of the branch did not converge; the frames up to there
                are written.
        """
        if self.pull is None:
            along = _poses(self.along, self.duration, progress) if self.along else None
            return _simulated(self, progress, along)
        asked, replayed, radius = _replay(self, self.pull)
        # Each frame at rest is a separate equilibrium, and a recording may last for minutes.
        rate = FRAME_RATE if asked.kind == "dynamic" else min(
            FRAME_RATE, _MOST_REPLAYED / replayed.duration)
        return _simulated(asked, progress, replayed, radius, rate, f"replay:{self.pull}")


def _simulated(asked: Simulate, progress: Progress, along: PoseTable | None,
               grasp_radius: float = GRASP_RADIUS_M, frame_rate: float = FRAME_RATE,
               key: str = KEY) -> dict[str, Any]:
    from limber.mechanics.materials.laws import law_digest, material_named
    from limber.mechanics.pull_simulation import (
        load_case_of,
        motion_of,
        require_one_drive,
        with_masses,
    )
    from limber.store.loading import load_grasp_point

    branch = Branch.open(asked.branch_folder)
    branch.require("mesh.vtu", "reconstruct")
    require_one_drive(asked, along)
    digests = {"along": along.digest(), "grasp_radius": str(grasp_radius)} if along else {}
    law = material_named(asked.material)
    if not law.is_compiled:
        digests["material"] = law_digest(law)
    reads = [name for name in ("mesh.vtu", "point_masses.json", "targets.json") if branch.has(name)]
    stored = branch.manifest.stages.get(key)
    if stored and stored.result.get("converged") and asked.is_kept(
            branch, key, reads=reads, digests=digests):
        return stored.result
    progress(0.0, "preparing")
    model = with_masses(_model(branch, asked, progress), asked)
    case = load_case_of(model, asked, along, load_grasp_point(branch), grasp_radius=grasp_radius,
                        frame_rate=frame_rate)
    motion = motion_of(case, asked, progress.part(0.2, 0.9))
    for message in motion.warnings:
        progress.warn(message)
    with branch.stage(key, asked, reads=reads, digests=digests) as stage:
        result = _write(stage, case.model, asked, motion, frame_rate)
        stage.result.update(result)
    progress(1.0, "done")
    if not motion.converged:
        raise ConvergenceError(
            Text("The branch could not follow the motion: ", motion.message),
            f"{result['frame_count']} frames up to the last valid state are in "
            f"frames/{asked.name}.pc2. The grasp force there is "
            f"{np.linalg.norm(result['grasp_force_n']):.3g} N.",
            "Pull less far, or check units and Young's modulus.")
    return branch.manifest.stages[key].result


def _model(branch: Branch, settings: SimulateSettings, progress: Progress) -> BranchModel:
    from limber.mechanics.materials.materials import RayleighDamping
    from limber.store.loading import Overrides, load_branch, load_model

    values: Overrides = {
        "young": settings.young, "material": settings.material,
        "damping": RayleighDamping(*settings.damping)}
    if SimulateSpec.of(settings).rest_shape:
        return load_branch(branch, gravity=settings.gravity, loaded=bool(settings.mass_at),
                           progress=progress, **values).model
    return load_model(branch, gravity=settings.gravity, **values)


def _write(stage: OpenStage, model: BranchModel, settings: SimulateSettings,
           motion: SimulatedMotion, frame_rate: float) -> dict[str, Any]:
    from limber.mechanics.strain import strain_state
    from limber.results.motion_files import (
        surface_fields,
        surface_nodes,
        write_pc2,
        write_pvd_series,
    )

    displacement = motion.displacement
    nodes = surface_nodes(model.mesh)
    write_pc2(stage.path(f"frames/{settings.name}.pc2"),
              model.mesh.nodes[nodes] + displacement[:, nodes])
    if settings.vtu:
        folder = stage.path(f"frames/{settings.name}/{settings.name}.pvd").parent
        write_pvd_series(folder, settings.name, model, motion.times, displacement)
    tip = int(np.linalg.norm(model.mesh.nodes - model.mesh.nodes[model.fixed].mean(axis=0),
                             axis=1).argmax())
    states = [strain_state(model, moved) for moved in displacement]
    strains = [float(state.principal_strain[:, -1].max()) for state in states]
    np.savez_compressed(stage.path(f"frames/{settings.name}.npz"),
                        **surface_fields(model.mesh, states))
    frames = {
        "frame_count": len(displacement), "rate": frame_rate,
        "times_s": motion.times.tolist(), "energies_j": motion.energy.tolist(),
        "kinetic_energies_j": motion.kinetic_energy.tolist(),
        "grasp_forces_n": motion.grasp_force.tolist(),
        "grasp_torques_nm": motion.grasp_torque.tolist(),
        "hold_forces_n": motion.hold_forces.tolist(), "min_det_f": motion.min_det_f.tolist(),
        "converged": motion.converged,
        "largest_principal_strains": strains,
        "largest_principal_stresses_pa": [
            float(s.principal_stress[:, -1].max()) for s in states]}
    stage.write(f"frames/{settings.name}.json", frames)
    return {
        "converged": motion.converged, "frame_count": len(displacement),
        "energy_j": float(motion.energy[-1]),
        "grasp_force_n": motion.grasp_force[-1].tolist(),
        "tip_displacement_m": (displacement[-1, tip] - displacement[0, tip]).tolist(),
        "min_det_f": float(motion.min_det_f.min()), "peak_strain": max(strains),
        "young_median_pa": float(np.median(model.young)),
        "peak_force_n": float(np.linalg.norm(motion.grasp_force, axis=-1).max(initial=0.0))}


def _replay(asked: Simulate, name: str) -> tuple[Simulate, PoseTable, float]:
    """Return the stage, the gripper's path and the grasp's radius [m] of a recording; InputError if
    there is none of that name, or its gripper does not drive the branch."""
    from limber.mechanics.dynamics.drive import PoseTable
    from limber.recordings.recording import read_pull
    from limber.store.loading import known_pulls

    if asked.along is not None:
        raise InputError(Text("Both ", Option("along"), " and ", Option("pull"), " were given."),
                         "Each states a path of the gripper.", "Give one of them.")
    branch = Branch.open(asked.branch_folder)
    if name not in known_pulls(branch):
        raise InputError(f"There is no pull {name!r}.",
                         f"There are: {', '.join(known_pulls(branch)) or 'none'}.",
                         "Import or record it first.")
    pull = read_pull(branch.path(f"pulls/{name}"))
    if pull.entry.motion == "swing":
        raise InputError(f"{name} is a free swing.", "A free swing has no gripper.",
                         Command("swing"), " fits it.")
    grasp, path = pull.entry.grasp, PoseTable(pull.times, pull.poses)
    kind = "static" if pull.entry.motion == "quasi_static" else "dynamic"
    return asked.model_copy(update={
        "name": name, "kind": kind, "hold": 0.0, "grasp_point": grasp.point_m,
        "grasp_mode": grasp.mode, "move": None, "turn": None, "grasp_force": None,
    }), path, grasp.radius_m


def _poses(path: Path, duration: float, progress: Progress) -> PoseTable:
    from limber.mechanics.dynamics.drive import PoseTable
    from limber.recordings.tables import read_table, robot_stream, time_column

    table = read_table(path)
    timed = time_column(table) is not None
    rate = None if timed else max(len(table.values) - 1, 1) / duration
    stream = robot_stream(path, rate_hz=rate)
    for message in stream.warnings:
        progress.warn(message)
    poses = stream.values[:, :6]
    if np.isnan(poses[:, 3:]).all():
        poses[:, 3:] = 0.0  # a table of positions only
    known = np.isfinite(poses).all(axis=1)
    return PoseTable(stream.times[known], poses[known])
