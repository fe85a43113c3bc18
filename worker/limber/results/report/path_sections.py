"""The report's section on paths."""

from limber.results.findings import beyond_sentence, certificate_sentence
from limber.results.report.report_tables import comparison_rows, leg_rows
from limber.results.report.section import Section
from limber.store import Branch


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
