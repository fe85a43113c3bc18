"""The report's sections on the energy field, on paths, and on their execution by a robot."""

from limber.core.errors import InputError
from limber.core.files.reading import read_arrays
from limber.planning.field.energy_field import EnergyField
from limber.results.findings import beyond_sentence, certificate_sentence
from limber.results.report import execution_section as execution
from limber.results.report import figures
from limber.results.report.report_tables import comparison_rows, leg_rows
from limber.results.report.section import Section
from limber.store import Branch


def energy_section(branch: Branch) -> Section:
    section = Section("Energy over grasp poses")
    if not branch.has("energy.npz"):
        section.missing = "limber energy NAME.branch"
        return section
    EnergyField.read(branch.path("energy.npz"))  # checks what is shown
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
    if rows := leg_rows(plan.get("legs", [])):
        section.tables.append(("The whole motion, leg by leg", rows))
    saved, added = plan["energy_saved_percent"], plan["length_added_percent"]
    section.text.append((
        "The start is inside the goal, so the paths have no length and no energy can be saved."
        if saved is None or added is None else
        f"The gentle path saves {saved:.1f} % of the energy along the path and changes the length "
        f"by {added:+.1f} %.") + f" Seed {plan['seed']}.")
    section.text.append(certificate_sentence(plan))
    if moving := plan.get("in_motion"):
        peaks = ", ".join(f"{key} {peak['moving']:.3g} ({peak['standing']:.3g} quasi-static)"
                          for key, peak in moving["peaks"].items())
        section.text.append(
            "A simulation over time on the full model, with inertia and at "
            f"{1e3 * moving['speed_m_s']:.0f} mm/s, keeps all limits. Peaks: {peaks}.")
    if beyond := beyond_sentence(plan):
        section.text.append(beyond)
    for figure, caption in plan_figures.report_figures(branch, name):
        section.draw(figure, caption)
    return section


def execution_section(branch: Branch, name: str) -> Section:
    section = Section(f"Executed by the robot: {name}", tables=[
        ("", execution.execution_rows(branch.manifest.stages[f"execute:{name}"].result))])
    try:
        section.draw(execution.force_along_path(
            branch.path(f"executions/{name}/samples.csv")),
            "Force of the gripper on the branch: measured (smoothed), and predicted at the "
            "gripper's measured position. The robot moves to the goal, waits and returns.")
    except InputError as error:
        section.text.append(f"The forces cannot be drawn: {error}")
    return section
