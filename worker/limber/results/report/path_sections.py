"""What the report says of the energy field, of paths, and of the robot that followed one."""

from limber.core.errors import InputError
from limber.core.files.reading import read_arrays
from limber.planning.field.energy_field import EnergyField
from limber.results.report import execution_section as execution
from limber.results.report import figures
from limber.results.report.section import Section
from limber.results.report.tables import comparison_rows
from limber.store import Branch


def energy_section(branch: Branch) -> Section:
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


def plan_section(branch: Branch, name: str) -> Section:
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


def execution_section(branch: Branch, name: str) -> Section:
    section = Section(f"By the robot: {name}", tables=[
        ("", execution.execution_rows(branch.manifest.stages[f"execute:{name}"].result))])
    try:
        section.draw(execution.force_along_the_way(
            branch.path(f"executions/{name}/samples.csv")),
            "Force of the gripper on the branch as felt (smoothed), and as predicted where the "
            "gripper was: there, standing and back.")
    except InputError as error:
        section.text.append(f"Its forces cannot be drawn: {error}")
    return section
