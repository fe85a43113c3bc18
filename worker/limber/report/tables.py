"""The tables that the report and the demo share, as rows of text with a header row."""

from collections.abc import Mapping
from typing import Any


def modulus_rows(estimate: Mapping[str, Any], pull: Mapping[str, Any] | None,
                 ) -> list[list[str]]:
    """Return estimated Young's modulus a control point, with truth and error where known.

    Args:
        estimate: ``young_pa`` [K] and ``young_interval_pa`` [K][2] [Pa].
        pull: What ``limber virtual-pull`` returned (``young_true_pa`` [K]), or None.
    """
    truth = (pull or {}).get("young_true_pa")
    header = ["control point", "E [MPa]", "95 % interval [MPa]"]
    rows = [[*header, "true E [MPa]", "error"] if truth else header]
    for number, young in enumerate(estimate["young_pa"]):
        row = [str(number + 1), f"{young / 1e6:.3f}", _interval(estimate, number)]
        if truth:
            row += [f"{truth[number] / 1e6:.3f}", f"{100 * (young / truth[number] - 1):+.1f} %"]
        rows.append(row)
    return rows


def comparison_rows(plan: Mapping[str, Any]) -> list[list[str]]:
    """Return the paper's comparison of both paths, with peaks and changes in percent."""
    rows = [["measure", "RRT*", "D-RRT*", "change"]]
    for label, key, unit in [
            ("path length", "length_m", "m"),
            ("energy along the path", "energy_integral_jm", "J m"),
            ("energy sum, 5 mm steps", "energy_sum_nmm", "N mm"),
            ("peak energy", "peak_energy_j", "J"), ("peak force", "peak_force_n", "N")]:
        before, after = plan["baseline"].get(key), plan["plan"].get(key)
        if before is None or after is None:
            continue
        change = f"{100 * (after / before - 1):+.1f} %" if before else "-"
        rows.append([f"{label} [{unit}]", f"{before:.4g}", f"{after:.4g}", change])
    return rows


def _interval(estimate: Mapping[str, Any], number: int) -> str:
    interval = (estimate.get("young_interval_pa") or {number: None})[number]
    if not interval or None in interval:
        return "undetermined"
    return f"{interval[0] / 1e6:.3f} to {interval[1] / 1e6:.3f}"
