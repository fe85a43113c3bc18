"""``report.html``: what was done to a branch, told in figures and tables, in one file."""

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import read_arrays
from limber.core.optional import require_extra
from limber.core.progress import SILENT, Progress
from limber.estimation.estimate_file import read_estimate
from limber.geometry.skeleton import qsm_tables
from limber.geometry.skeleton.doubtful_parts import Doubt, doubtful_parts
from limber.geometry.skeleton.qsm_tables import Caliper
from limber.geometry.tets.tet_mesh import TetMesh
from limber.planning.field.energy_field import EnergyField
from limber.results.motion_files import read_frames_file
from limber.results.report import execution_section, figures, loads_section, swing_section
from limber.results.report.ringing_section import vibration_rows
from limber.results.report.tables import (
    ASSUMED,
    caliper_rows,
    cause_rows,
    comparison_rows,
    deviation_rows,
    diameter_rows,
    doubt_rows,
    held_out_rows,
    is_assumed,
    modulus_rows,
    order_rows,
    share_rows,
)
from limber.store import Branch
from limber.store.loading import load_skeleton, load_targets
from limber.version import VERSION

_SOURCE_LABELS = {"file": "made from", "unit": "its unit", "sha256": "its sha256",
                  "truth": "known truth"}
_DOUBTS_SHOWN = 12
_QUALITY_LABELS = {
    "volume_ratio": "mesh over surface volume",
    "min_dihedral_deg": "smallest angle between faces [degrees]",
    "min_radius_ratio": "worst shape of a tetrahedron (1 regular, 0 flat)",
    "mean_radius_ratio": "mean shape",
    "elements_across": "elements across the branch",
    "surface_distance_mean": "mean distance of mesh and surface [local radii]",
    "surface_distance_max_m": "largest distance of mesh and surface [m]",
    "fork_distance_mean": "mean distance at forks [local radii]",
    "fork_distance_max": "largest distance at forks [local radii]"}


@dataclass
class Section:
    """One part of the page; ``missing`` tells which command would fill it."""

    title: str
    text: list[str] = field(default_factory=list)
    pictures: list[tuple[str, str]] = field(default_factory=list)
    tables: list[tuple[str, list[list[str]]]] = field(default_factory=list)
    missing: str = ""

    def draw(self, figure: Any, caption: str) -> None:
        """Add a matplotlib figure, as a PNG inside the page."""
        self.pictures.append((_inline_png(_png(figure)), caption))


def draw_page(branch: Branch, *, picture: Path | None = None, calipers: Sequence[Caliper] = (),
              progress: Progress = SILENT) -> tuple[str, list[Section]]:
    """Return the page of whatever stages a branch has, as HTML, and its sections.

    Args:
        picture: A render of the scene to put at the top, PNG.
        calipers: Diameters that somebody measured, to hold beside the scan's.

    Raises:
        InputError: the picture is none, or a diameter stands beyond the branch.
        MissingDependencyError: what the extra ``report`` brings is not installed.
    """
    require_extra("report", ("matplotlib", "jinja2"), "The report")
    page = [*_held_back(branch), _summary(branch, picture)]
    builders: list[Callable[[Branch], Section]] = [
        _scan, partial(_cylinders, calipers=calipers), _mesh, *_pulls(branch), _estimate,
        *([_swing] if branch.has("swing.json") else []),
        *([_vibration] if branch.has("vibration.json") else []), *_simulations(branch),
        *_loads(branch), _energy, *_plans(branch), *_executions(branch), _provenance]
    for number, build in enumerate(builders):
        progress(number / len(builders), "drawing")
        page.append(build(branch))
    return _render(branch, page), page


def _held_back(branch: Branch) -> list[Section]:
    """What makes the estimate unsure, and what would help: before anything else is read."""
    if not branch.has("estimate.json"):
        return []
    estimate = read_estimate(branch.path("estimate.json"))
    rows = cause_rows(estimate)
    if not rows:
        return []
    total = max((estimate.get("young_deviation") or {}).get("total") or [float("nan")])
    return [Section("What holds the estimate back", text=[
        f"Young's modulus is known to a standard deviation of {100 * total:.1f} % where it is "
        "known least. Most of that comes from the following, largest first."],
        tables=[("", rows)])]


def _summary(branch: Branch, picture: Path | None) -> Section:
    section = Section("Summary")
    if picture is not None:
        section.pictures.append((_inline_png(_read_png(picture)), "The scene, rendered."))
    if is_assumed(_virtual_result(branch)):
        section.text.append(ASSUMED)
    result = _reconstruction(branch)
    rows = [["what", "value"]]
    source = branch.manifest.source
    rows += [[_SOURCE_LABELS.get(key, key.replace("_", " ")), str(value)]
             for key, value in source.items() if isinstance(value, str | int | float)]
    for key, label, form in [
            ("point_count", "points used", "{:,.0f}"), ("branch_count", "branches", "{:.0f}"),
            ("length_m", "centreline, all branches [m]", "{:.3f}"),
            ("radius_min_m", "smallest radius [m]", "{:.5f}"),
            ("radius_max_m", "largest radius [m]", "{:.5f}"),
            ("tet_count", "tetrahedra", "{:,.0f}")]:
        if result.get(key) is not None:
            rows.append([label, form.format(result[key])])
    for name, unit, scale in (("length", "m", 1.0), ("volume", "m3", 1e6)):
        interval = result.get(f"{name}_interval_{unit}")
        if interval:
            values = [f"{scale * v:.4g}" for v in (result[f"expected_{name}_{unit}"], *interval)]
            rows.append([f"{name} of wood, doubted twigs by their probability (95 %) "
                         f"[{'cm3' if scale > 1 else unit}]",
                         f"{values[0]} ({values[1]} to {values[2]})"])
    section.tables.append(("", rows))
    return section


def _scan(branch: Branch) -> Section:
    section = Section("Scan and skeleton")
    if not (branch.has("cloud.ply") and branch.has("skeleton.swc")):
        section.missing = "limber reconstruct CLOUD -o NAME.branch"
        return section
    targets = _targets(branch)
    section.draw(figures.scan_and_skeleton(branch, targets),
                 "The aligned cloud (grey) with the centreline tree, one colour an order, the "
                 "control points (rings) and named targets (stars); from the front and from the "
                 "side.")
    if targets:
        section.tables.append(("Named targets", [
            ["target", "x [m]", "y [m]", "z [m]", "mass [kg]"],
            *([target["name"], *(f"{value:.3f}" for value in target["position_m"]),
               f"{target['mass_kg']:.4g}"] for target in targets)]))
    section.draw(figures.radii(branch), "Radius along the centreline, with its uncertainty where "
                                        "it is known, one colour an order.")
    result = _reconstruction(branch)
    section.text += result.get("warnings") or []
    doubtful = doubtful_parts(load_skeleton(branch))
    if doubtful:
        section.tables.append(_doubt_table(doubtful))
    if result.get("clamped_radius_count"):
        section.text.append(f"{result['clamped_radius_count']} radii were limited to the cloud's "
                            "scale.")
    return section


def _doubt_table(doubtful: list[Doubt]) -> tuple[str, list[list[str]]]:
    rows = doubt_rows([{"kind": doubt.kind, "branch": doubt.branch, "at": np.round(doubt.at, 4),
                        "length_m": doubt.length, "radius_m": doubt.radius, "value": doubt.value}
                       for doubt in doubtful[:_DOUBTS_SHOWN]])
    rest = len(doubtful) - _DOUBTS_SHOWN
    more = f"; {rest} more: limber skeleton" if rest > 0 else ""
    return f"Doubtful parts of the skeleton, places in the branch's frame [m]{more}", rows


def _cylinders(branch: Branch, calipers: Sequence[Caliper]) -> Section:
    section = Section("Cylinder model")
    if not branch.has("skeleton.swc"):
        section.missing = "limber reconstruct CLOUD -o NAME.branch"
        return section
    skeleton = load_skeleton(branch)
    compared = qsm_tables.against_calipers(skeleton, list(calipers))
    shares = _reconstruction(branch).get("length_shares")
    if shares:
        section.tables.append(("How the radii are known", share_rows(shares)))
    section.tables.append(("By branching order (0 is the main axis)",
                           order_rows(qsm_tables.by_order(skeleton))))
    section.tables.append(("Diameters along the main path",
                           diameter_rows(qsm_tables.diameters_at_heights(skeleton))))
    if compared:
        section.tables.append(("Against calipers", caliper_rows(compared)))
    section.draw(figures.diameters(skeleton, compared),
                 "Diameter along the main path; the band is two standard deviations to each side.")
    return section


def _targets(branch: Branch) -> list[dict[str, Any]]:
    return [{"name": target.name, "position_m": target.position, "mass_kg": target.mass}
            for target in load_targets(branch)]


def _mesh(branch: Branch) -> Section:
    section = Section("Mesh")
    if not branch.has("mesh.vtu"):
        section.missing = "limber reconstruct or limber mesh"
        return section
    section.draw(figures.mesh_by_modulus(branch), "The tetrahedral mesh, coloured by Young's "
                                                  "modulus; base in black, grasp patch in red.")
    result = _reconstruction(branch)
    quality = result.get("mesh_quality") or {}
    rows = [["what", "value"]]
    for key in ("surface_volume_m3", "mesh_volume_m3"):
        if result.get(key) is not None:
            rows.append([key.replace("_m3", " [cm3]").replace("_", " "),
                         f"{1e6 * result[key]:.4g}"])
    rows += [[label, f"{quality[key]:.4g}"] for key, label in _QUALITY_LABELS.items()
             if quality.get(key) is not None]
    if len(rows) > 1:
        section.tables.append(("", rows))
    return section


def _pulls(branch: Branch) -> list[Callable[[Branch], Section]]:
    names = branch.names("pulls")
    if not names:
        return [lambda _branch: Section("Pulls", missing="limber import-pull or virtual-pull")]
    return [partial(_pull, name=name) for name in names]


def _pull(branch: Branch, name: str) -> Section:
    from limber.recordings.recording import read_pull

    section = Section(f"Pull {name}")
    pull = read_pull(branch.path(f"pulls/{name}"))
    if _is_virtual(branch, name):
        section.text.append(
            f"This pull was simulated, with {'a known' if _has_truth(branch) else 'an assumed'} "
            "Young's modulus and sensor noise, on another and finer mesh: there is no robot "
            "recording of this branch.")
    section.draw(figures.pull(pull), "Force on the branch and displacement of the grasp over time.")
    return section


def _estimate(branch: Branch) -> Section:
    section = Section("Young's modulus along the branch")
    if not branch.has("estimate.json"):
        section.missing = "limber estimate NAME.branch"
        return section
    from limber.results.report import estimate_figures

    estimate = read_estimate(branch.path("estimate.json"))
    virtual = _virtual_result(branch)
    section.tables.append((
        "Estimated" if not virtual else "Estimated against assumed" if is_assumed(virtual)
        else "Estimated against true", modulus_rows(estimate, virtual)))
    if is_assumed(virtual):
        section.text.append(ASSUMED)
        if estimate.get("truth"):
            estimate["truth"]["assumed"] = True
    for title, rows in [
            ("What makes it unsure: standard deviations", deviation_rows(estimate)),
            ("Pulls foretold by a fit that did not see them: RMS errors",
             held_out_rows(estimate))]:
        if rows:
            section.tables.append((title, rows))
    section.text.append(
        f"Method: {estimate['method']}; {estimate['forward_count']} forward simulations; "
        f"loss {estimate['loss_m2']:.3g} m²; "
        f"{'converged' if estimate['converged'] else 'NOT converged'}.")
    for figure, caption in estimate_figures.report_figures(estimate):
        section.draw(figure, caption)
    section.text += estimate.get("warnings", [])
    return section


def _swing(branch: Branch) -> Section:
    swing = swing_section.read_swing(branch.path("swing.json"))
    section = Section(f"Swing {swing.pull}", text=swing.warnings,
                      tables=[("", swing_section.swing_rows(swing))])
    section.draw(swing_section.swing_over_time(swing),
                 "The marker that swings most, along its way: seen (dots) and simulated.")
    return section


def _vibration(branch: Branch) -> Section:
    modulus, vibrations = vibration_rows(branch.path("vibration.json"))
    return Section("Ringing", tables=[("", modulus), ("Vibrations of the record", vibrations)])


def _simulations(branch: Branch) -> list[Callable[[Branch], Section]]:
    keys = [key for key in branch.manifest.stages if key.split(":")[0] == "simulate"]
    if not keys:
        return [lambda _branch: Section("Simulated motion",
                                        missing="limber simulate NAME.branch")]
    return [partial(_simulation, key=key) for key in keys]


def _simulation(branch: Branch, key: str) -> Section:
    entry = branch.manifest.stages[key]
    section = Section(f"Simulated motion: {entry.settings['name']}")
    frames = read_frames_file(branch.path(f"frames/{entry.settings['name']}.json")).model_dump()
    section.draw(figures.motion(frames), "Strain and kinetic energy, and the force on the grasp, "
                                         "over time.")
    if not entry.result["converged"]:
        section.text.append("The branch could not follow to the end; the frames stop at the last "
                            "good state.")
    tip = np.linalg.norm(entry.result["tip_displacement_m"])
    section.text.append(
        f"{entry.result['frame_count']} frames. At the end the tip has moved by "
        f"{1e3 * tip:.1f} mm and the branch holds {entry.result['energy_j']:.4g} J; smallest "
        f"det F {min(frames['min_det_f']):.3f}.")
    return section


def _loads(branch: Branch) -> list[Callable[[Branch], Section]]:
    names = [name.removesuffix(".json") for name in branch.names("loads") if name.endswith(".json")]
    return [partial(_load, name=name) for name in names]


def _load(branch: Branch, name: str) -> Section:
    section = Section(f"Load: {name}", tables=[
        ("", loads_section.load_rows(loads_section.read_load(branch.path(f"loads/{name}.json"))))])
    frames = f"frames/load-{name}.pc2"
    if branch.has(frames) and branch.has(f"frames/load-{name}.npz"):
        try:
            section.draw(loads_section.bent_branch(TetMesh.read(branch.path("mesh.vtu")),
                                           branch.path(frames)),
                         "The branch as scanned (grey) and at rest under the loads, from the "
                         "front and from the side.")
        except InputError as error:
            section.text.append(f"It cannot be drawn: {error}")
    return section


def _energy(branch: Branch) -> Section:
    section = Section("Energy over grasp poses")
    if not branch.has("energy.npz"):
        section.missing = "limber energy NAME.branch"
        return section
    EnergyField.read(branch.path("energy.npz"))  # what is shown has been checked
    data = read_arrays(branch.path("energy.npz"), "an energy field")
    section.draw(figures.energy_samples(data), "Strain energy of the sampled grasp poses "
                                               "against the distance from rest, and the force.")
    error = {key: float(data[key]) for key in ("energy_error", "force_error") if key in data}
    result = branch.manifest.stages["energy"].result
    section.text.append(
        f"{result['sample_count']} poses solved, {result['rejected_count']} rejected. Held-out "
        f"error of the radial basis functions: energy {100 * error.get('energy_error', 0):.2g} %, "
        f"force {100 * error.get('force_error', 0):.2g} %.")
    return section


def _plans(branch: Branch) -> list[Callable[[Branch], Section]]:
    names = sorted(key.split(":", 1)[1] for key in branch.manifest.stages
                   if key.startswith("plan:"))
    if not names:
        return [lambda _branch: Section("Paths", missing="limber plan NAME.branch")]
    return [partial(_plan, name=name) for name in names]


def _plan(branch: Branch, name: str) -> Section:
    from limber.planning.plan_file import read_plan
    from limber.results.report import plan_figures

    section = Section(f"Paths: {name}")
    plan = read_plan(branch.path(f"plans/{name}.json")).summary
    section.tables.append(("Shortest path (length alone) against the gentle one "
                           "(deformation-aware), both scored on the full model",
                           comparison_rows(plan)))
    saved, added = plan["energy_saved_percent"], plan["length_added_percent"]
    section.text.append((
        "The start lies in the goal: the paths have no length, and there is nothing to save."
        if saved is None or added is None else
        f"The gentle path saves {saved:.1f} % of the energy along the "
        f"path for {added:+.1f} % of length.") + f" Seed {plan['seed']}.")
    if (gap := (plan.get("certificate") or {}).get("gap_percent")) is not None:
        section.text.append(f"Certificate: on the energy field it is at most {gap:.1f} % above the "
                            "best possible path; no path is cheaper than the lower bound.")
    if whole := (plan.get("certificate") or {}).get("full_model"):
        if whole["gap_percent"] is not None:
            section.text.append(
                f"On the full model, the field being off by {1e3 * whole['field_error_j']:.2g} mJ: "
                f"at most {whole['gap_percent']:.1f} % above the best possible path.")
    if moving := plan.get("in_motion"):
        peaks = ", ".join(f"{key} {peak['moving']:.3g} ({peak['standing']:.3g} standing still)"
                          for key, peak in moving["peaks"].items())
        section.text.append(
            f"Moved in time on the full model, with inertia, at {1e3 * moving['speed_m_s']:.0f} "
            f"mm/s, the whole motion keeps its limits: peaks {peaks}.")
    for figure, caption in plan_figures.report_figures(branch, name):
        section.draw(figure, caption)
    return section


def _executions(branch: Branch) -> list[Callable[[Branch], Section]]:
    names = sorted(key.split(":", 1)[1] for key in branch.manifest.stages
                   if key.startswith("execute:"))
    return [partial(_execution, name=name) for name in names]


def _execution(branch: Branch, name: str) -> Section:
    section = Section(f"By the robot: {name}", tables=[
        ("", execution_section.execution_rows(branch.manifest.stages[f"execute:{name}"].result))])
    try:
        section.draw(execution_section.force_along_the_way(
            branch.path(f"executions/{name}/samples.csv")),
            "Force of the gripper on the branch as felt (smoothed), and as predicted where the "
            "gripper was: there, standing and back.")
    except InputError as error:
        section.text.append(f"Its forces cannot be drawn: {error}")
    return section


def _provenance(branch: Branch) -> Section:
    section = Section("How it was made")
    rows = [["stage", "finished", "settings"]]
    programs: dict[str, str] = {}
    for key, entry in branch.manifest.stages.items():
        shown = ", ".join(f"{name} {_setting(value)}" for name, value in entry.settings.items()
                          if value not in (None, []))
        rows.append([key, entry.finished[:16].replace("T", " "), shown])
        programs |= entry.programs
    section.tables.append(("Stages (times in UTC)", rows))
    section.tables.append(("Programs", [["program", "version"],
                                        *([name, v] for name, v in sorted(programs.items()))]))
    return section


def _setting(value: Any) -> str:
    if isinstance(value, list):
        return "(" + ", ".join(map(_setting, value)) + ")"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _reconstruction(branch: Branch) -> dict[str, Any]:
    for key in ("reconstruct", "mesh"):
        if key in branch.manifest.stages:
            return branch.manifest.stages[key].result
    return {}


def _is_virtual(branch: Branch, name: str) -> bool:
    entry = branch.manifest.stages.get(f"pull:{name}")
    return entry is not None and entry.result.get("young_true_pa") is not None


def _virtual_result(branch: Branch) -> dict[str, Any] | None:
    names = [name for name in branch.names("pulls") if _is_virtual(branch, name)]
    if not names:
        return None
    return branch.manifest.stages[f"pull:{names[0]}"].result | {
        "young_assumed": not _has_truth(branch)}


def _has_truth(branch: Branch) -> bool:
    """Whether the branch was generated: of a scan of another one no modulus is known."""
    return branch.has("truth/truth.json")


def _read_png(path: Path) -> bytes:
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).", "It was to open the report.",
                         "Leave out --picture, or name the PNG of `limber scene`.") from error
    if not data.startswith(b"\x89PNG"):
        raise InputError(f"{path} is not a PNG file.", "The page shows PNG.", "Name a PNG.")
    return data


def _png(figure: Any) -> bytes:
    import matplotlib.pyplot as plt

    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=130, bbox_inches="tight")
    plt.close(figure)
    return stream.getvalue()


def _inline_png(data: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(data).decode("ascii")


def _render(branch: Branch, page: list[Section]) -> str:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("limber.results.report", "."), autoescape=True,
        undefined=jinja2.StrictUndefined)
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return environment.get_template("page.html").render(
        name=branch.name, sections=page, made=made, version=VERSION)
