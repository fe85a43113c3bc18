"""``report.html``: figures and tables of all results of a branch, in one file."""

from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.core.optional import require_extra
from limber.core.progress import SILENT, Progress
from limber.estimation.estimate_file import read_estimate
from limber.geometry.skeleton.qsm_tables import Caliper
from limber.geometry.tets.tet_mesh import TetMesh
from limber.results.findings import (
    ASSUMED,
    ASSUMED_PULL,
    beyond_sentence,
    certificate_sentence,
    modulus_sentence,
    path_sentence,
    peaks_line,
    simulated_pull,
)
from limber.results.motion_files import read_frames_file
from limber.results.report import figures, loads_section, swing_section
from limber.results.report.path_sections import energy_section, execution_section, plan_section
from limber.results.report.report_tables import (
    action_rows,
    cause_rows,
    deviation_rows,
    held_out_rows,
    is_assumed,
    modulus_rows,
    pull_rows,
    rigidity_rows,
)
from limber.results.report.ringing_section import vibration_rows
from limber.results.report.section import Section, inline_png
from limber.results.report.shape_sections import (
    cylinders_section,
    mesh_section,
    scan_section,
)
from limber.store import Branch
from limber.version import VERSION

_SOURCE_LABELS = {"file": "source", "unit": "unit of length", "sha256": "sha256 of the source",
                  "truth": "known truth"}


def draw_page(branch: Branch, *, calipers: Sequence[Caliper] = (), progress: Progress = SILENT,
              ) -> tuple[str, list[Section]]:
    """Return the page for the stages that have been run, as HTML, and its sections.

    Args:
        calipers: Caliper diameters to compare with the scan's.

    Raises:
        InputError: a diameter's position is beyond the branch.
        MissingDependencyError: the packages of the extra ``report`` are not installed.
    """
    require_extra("report", ("matplotlib", "jinja2"), "The report")
    page = [_found(branch), *_held_back(branch), _summary(branch)]
    loads = [name.removesuffix(".json") for name in branch.names("loads")
             if name.endswith(".json")]
    motions = [key for key in branch.manifest.stages if key.split(":")[0] == "simulate"]
    builders: list[Callable[[Branch], Section]] = [
        scan_section, partial(cylinders_section, calipers=calipers), mesh_section,
        *_each(_pull, branch.names("pulls"), "Pulls", "limber import-pull or virtual-pull"),
        _estimate, *([_swing] if branch.has("swing.json") else []),
        *([_vibration] if branch.has("vibration.json") else []),
        *_each(_simulation, motions, "Simulated motion",
               "limber simulate NAME.branch"),
        *_each(_load, loads), energy_section,
        *_each(plan_section, _names(branch, "plan"), "Paths",
               "limber plan NAME.branch"),
        *_each(execution_section, _names(branch, "execute")), _provenance]
    for number, build in enumerate(builders):
        progress(number / len(builders), "drawing")
        page.append(build(branch))
    return _render(branch, page), page


def _each(build: Callable[..., Section], names: Iterable[str], title: str = "",
          missing: str = "") -> list[Callable[[Branch], Section]]:
    """Return a builder for each name's section; without names, one for a missing section."""
    found: list[Callable[[Branch], Section]] = [partial(build, name=name) for name in names]
    return found or ([lambda _branch: Section(title, missing=missing)] if title else [])


def _names(branch: Branch, stage: str) -> list[str]:
    """The names of a stage's results, sorted."""
    return sorted(key.partition(":")[2] for key in branch.manifest.stages
                  if key.startswith(f"{stage}:"))


def with_picture(html: str, png: bytes) -> str:
    """Return a page with a render of the scene at the end of its first section."""
    figure = (f'<figure><img src="{inline_png(png)}" alt="Rendered scene.">'
              "<figcaption>Rendered scene.</figcaption></figure>\n")
    return html.replace("</section>", f"{figure}</section>", 1)


def _found(branch: Branch) -> Section:
    """The findings in one paragraph, and their limits."""
    section, pull = Section("What was found"), simulated_pull(branch)
    if pull is not None:
        section.text.append(ASSUMED if pull["young_assumed"] else (
            "The branch was generated and its pull simulated, so that the true modulus is known."))
    sentences = []
    if branch.has("estimate.json"):
        sentences.append(modulus_sentence(
            read_estimate(branch.path("estimate.json")),
            ASSUMED_PULL if is_assumed(pull) else ""))
    else:
        sentences.append("Young's modulus has not been estimated from a pull: what follows holds "
                         "for the modulus that the mesh has.")
    plans = [branch.manifest.stages[f"plan:{name}"] for name in _names(branch, "plan")]
    if plans:
        newest = max(plans, key=lambda entry: entry.finished).result
        sentences += [path_sentence(newest), certificate_sentence(newest), beyond_sentence(newest)]
    section.text.append(" ".join(filter(None, sentences)))
    return section


def _held_back(branch: Branch) -> list[Section]:
    """The causes of the estimate's uncertainty and their remedies: the first section."""
    if not branch.has("estimate.json"):
        return []
    estimate = read_estimate(branch.path("estimate.json"))
    rows = cause_rows(estimate)
    if not rows:
        return []
    actions = action_rows(estimate)
    total = max((estimate.get("young_deviation") or {}).get("total") or [float("nan")])
    return [Section("What limits the estimate", text=[
        f"The largest standard deviation of Young's modulus along the branch is {100 * total:.1f} "
        "%. Its main causes follow, largest first."],
        tables=[("", rows), *([("What to do next, best first", actions)] if actions else [])])]


def _summary(branch: Branch) -> Section:
    section = Section("Summary")
    result = branch.made.result if branch.made else {}
    rows = [["item", "value"]]
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
            rows.append([f"{name} of wood, uncertain twigs weighted by their probability (95 % "
                         f"interval) [{'cm3' if scale > 1 else unit}]",
                         f"{values[0]} ({values[1]} to {values[2]})"])
    section.tables.append(("", rows))
    return section


def _pull(branch: Branch, name: str) -> Section:
    from limber.recordings.recording import read_pull

    section = Section(f"Pull {name}")
    pull = read_pull(branch.path(f"pulls/{name}"))
    if _is_virtual(branch, name):
        section.title += " (simulated)"
        section.text.append(
            "This pull was simulated on a separate, finer mesh, with "
            f"{'a known' if _has_truth(branch) else 'an assumed'} Young's modulus and sensor "
            "noise. There is no robot recording of this branch.")
    section.draw(figures.pull(pull), "Force on the branch and displacement of the grasp over time.")
    return section


def _estimate(branch: Branch) -> Section:
    section = Section("Young's modulus along the branch")
    if not branch.has("estimate.json"):
        section.missing = "limber estimate NAME.branch"
        return section
    from limber.results.report import estimate_figures

    estimate = read_estimate(branch.path("estimate.json"))
    virtual = simulated_pull(branch)
    section.tables.append((
        "Estimated" if not virtual else "Estimated against assumed" if is_assumed(virtual)
        else "Estimated against true", modulus_rows(estimate, virtual)))
    if is_assumed(virtual):
        section.text.append(ASSUMED)
        if estimate.get("truth"):
            estimate["truth"]["assumed"] = True
    for title, rows in [
            ("Flexural rigidity (I: mean of the control point's part)", rigidity_rows(estimate)),
            ("Sources of uncertainty: standard deviations", deviation_rows(estimate)),
            ("Modulus by pull", pull_rows(estimate)),
            ("Pulls predicted by a fit without them: RMS errors",
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
                 "Displacement of the marker that swings most, along its path: observed (dots) "
                 "and simulated.")
    return section


def _vibration(branch: Branch) -> Section:
    modulus, vibrations = vibration_rows(branch.path("vibration.json"))
    return Section("Ringing", tables=[("", modulus), ("Vibrations in the recording", vibrations)])


def _simulation(branch: Branch, name: str) -> Section:
    entry = branch.manifest.stages[name]
    section = Section(f"Simulated motion: {entry.settings['name']}")
    frames = read_frames_file(branch.path(f"frames/{entry.settings['name']}.json")).model_dump()
    section.draw(figures.motion(frames), "Strain and kinetic energy, and the force on the grasp, "
                                         "over time.")
    if not entry.result["converged"]:
        section.text.append("The simulation did not converge to the end; the frames stop at the "
                            "last converged state.")
    tip = np.linalg.norm(entry.result["tip_displacement_m"])
    section.text.append(
        f"{entry.result['frame_count']} frames. At the end the tip has moved by {1e3 * tip:.1f} "
        f"mm and the branch stores {entry.result['energy_j']:.4g} J. The smallest det F is "
        f"{min(frames['min_det_f']):.3f}.")
    if frames["largest_principal_strains"]:
        forces = np.linalg.norm(frames["grasp_forces_n"] or [[0.0]], axis=1)
        section.text.append(peaks_line({"young_median_pa": entry.result.get("young_median_pa"),
                                        "peak_strain": max(frames["largest_principal_strains"]),
                                        "peak_force_n": float(forces.max())}))
    return section


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
            section.text.append(f"The bent branch cannot be drawn: {error}")
    return section


def _provenance(branch: Branch) -> Section:
    section = Section("How it was made")
    rows = [["stage", "finished", "settings"]]
    programs: dict[str, str] = {}
    for key, entry in branch.manifest.stages.items():
        settings_text = ", ".join(f"{name} {_setting(value)}" for name, value
                                  in entry.settings.items()
                                  if value not in (None, []))
        rows.append([key, entry.finished[:16].replace("T", " "), settings_text])
        programs |= entry.programs
    section.tables.append(("Stages (times in UTC)", rows))
    section.tables.append(("Programs", [["program", "version"],
                                        *([name, v] for name, v in sorted(programs.items()))]))
    return section


def _setting(value: Any) -> str:
    if isinstance(value, list):
        return "(" + ", ".join(map(_setting, value)) + ")"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _is_virtual(branch: Branch, name: str) -> bool:
    entry = branch.manifest.stages.get(f"pull:{name}")
    return entry is not None and entry.result.get("young_true_pa") is not None


def _has_truth(branch: Branch) -> bool:
    """Whether the branch was generated; the true modulus of any other scan is unknown."""
    return branch.has("truth/truth.json")


def _render(branch: Branch, page: list[Section]) -> str:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("limber.results.report", "."), autoescape=True,
        undefined=jinja2.StrictUndefined)
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return environment.get_template("page.html").render(
        name=branch.name, sections=page, made=made, version=VERSION)
