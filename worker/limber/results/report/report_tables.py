"""The tables that the report and the demo share, as rows of text with a header row."""

import math
from collections.abc import Mapping, Sequence
from itertools import count
from operator import itemgetter
from typing import Any

from limber.core.units import place_text, table_of
from limber.results.findings import ASSUMED


def modulus_rows(estimate: Mapping[str, Any], pull: Mapping[str, Any] | None,) -> list[list[str]]:
    """Return estimated Young's modulus [Pa] per control point, with truth and error if the pull, of
    ``limber virtual-pull``, has ``young_true_pa``; ``young_assumed``: of a scan without a real
    pull."""
    truth = true_moduli(estimate, pull or {})
    header = ["control point", "E [MPa]", "95 % interval [MPa]"]
    titles = ["assumed E [MPa]", "difference"] if is_assumed(pull) else ["true E [MPa]", "error"]
    rows = [[*header, *titles, "in the interval"] if truth else header]
    for number, young in enumerate(estimate["young_pa"]):
        row = [str(number + 1), _mpa(young), _interval(estimate, number)]
        if truth:
            row += [_mpa(truth[number]), f"{100 * (young / truth[number] - 1):+.1f} %",
                    "yes" if _holds(estimate, number, truth[number]) else "NO"]
        rows.append(row)
    return rows


def true_moduli(estimate: Mapping[str, Any], pull: Mapping[str, Any]) -> list[float]:
    """Return the true moduli of a simulated pull at an estimate's control points [Pa], [K], by
    inverse-distance weights as the paper's between its own ``fractions``; empty if not known
    there."""
    truth, count = list(pull.get("young_true_pa") or []), len(estimate["young_pa"])
    known, asked = pull.get("fractions"), estimate.get("fractions")
    if not (truth and known and asked):
        return truth if len(truth) == count else []
    return [math.fsum(share * value for share, value in zip(shares, truth, strict=True))
            / math.fsum(shares)
            for shares in ([1 / max(abs(place - each), 1e-6)**2 for each in known]
                           for place in asked)]


def rigidity_rows(estimate: Mapping[str, Any]) -> list[list[str]]:
    """Return bending stiffness E I per control point; none if the shape was not judged."""
    if not estimate.get("bending_stiffness_nm2"):
        return []
    return table_of(
        zip(estimate["bending_stiffness_nm2"], estimate["bending_stiffness_interval_nm2"],
            count(1), strict=False),
        ("control point", itemgetter(2)), ("E I [N m^2]", itemgetter(0), ".4g"),
        ("E I [N mm^2]", lambda each: 1e6 * each[0], ".4g"),
        ("95 % interval [N m^2]", lambda each: "{:.4g} to {:.4g}".format(*each[1])))


def held_sentence(estimate: Mapping[str, Any], pull: Mapping[str, Any]) -> str:
    """How many 95 % intervals contain the truth, in words; arguments of :func:`modulus_rows`."""
    truth = true_moduli(estimate, pull)
    held = sum(_holds(estimate, number, value) for number, value in enumerate(truth))
    return f"{held} of {len(truth)} intervals (95 %) contain the " + (
        f"assumed modulus. {ASSUMED}" if is_assumed(pull) else "true modulus.")


def is_assumed(pull: Mapping[str, Any] | None) -> bool:
    """Whether the modulus of a simulated pull is assumed, not the true one of the scanned branch.
    """
    return bool((pull or {}).get("young_assumed"))


def leg_rows(legs: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return a plan's legs in order; a row is left empty where nothing moves or is known."""
    moving = [leg if leg["length_m"] > 0.0 else {**leg, "length_m": None, "peak_speed_m_s": None}
              for leg in legs]
    return table_of(
        moving, ("leg", "name"), ("from [s]", "start_s", ".1f"), ("for [s]", "duration_s", ".1f"),
        ("length [mm]", "length_m", ".0f mm"), ("speed [mm/s]", "peak_speed_m_s", ".0f mm"),
        ("force [N]", "peak_force_n", ".3g"),
        ("to obstacles [mm]", "obstacle_distance_m", ".0f mm"),
        ("arm to branch [mm]", "branch_distance_m", ".0f mm"))


def deviation_rows(estimate: Mapping[str, Any]) -> list[list[str]]:
    """Return the sources of each modulus's uncertainty (``young_deviation``: ``sensor``,
    ``geometry``, ``mesh``, ``total``, [K] of log E, None if not examined), as standard deviations
    in percent."""
    from limber.estimation.fitting.nuisances import OTHER_CAUSES

    parts = estimate.get("young_deviation") or {}
    known = {"sensor": "from sensors", **{
        name: f"from the {cause.name}" for name, cause in OTHER_CAUSES.items()
        if name in ("geometry", "mesh") or parts.get(name)}, "total": "together"}
    if not any(parts.get(name) for name in known):
        return []
    return [["control point", "position (0 base, 1 tip)", *known.values()], *(
        [str(number + 1), f"{fraction:.2f}", *(
            "not examined" if not parts.get(name) else "not known"
            if parts[name][number] is None else f"{100 * parts[name][number]:.1f} %"
            for name in known)] for number, fraction in enumerate(estimate["fractions"]))]


def cause_rows(estimate: Mapping[str, Any]) -> list[list[str]]:
    """Return the causes of the moduli's uncertainty, largest first, and how to reduce each
    (:func:`limber.estimation.uncertainty.covariance.largest`)."""
    return table_of(
        estimate.get("causes") or [], ("cause", "cause"),
        ("fraction of the variance", "share", ".0f %"),
        ("resulting deviation of E",
         lambda each: f"up to {100 * min(each['deviation'], 99.0):.1f} %"),
        ("what would reduce it", "advice"))


def action_rows(estimate: Mapping[str, Any]) -> list[list[str]]:
    """Return what to do next, best first, and the interval of E to expect after each
    (:meth:`limber.estimation.uncertainty.next_actions.Prospects.best`)."""
    return table_of(
        estimate.get("next_actions") or [], ("action", "action"), ("how", "how"),
        ("intervals shrink by", lambda each: 1 - each["width_share"], ".0f %"),
        ("E then known to [MPa]", lambda each: "; ".join(
            f"{low / 1e6:.4g} to {high / 1e6:.4g}" for low, high in each["young_interval_pa"])))


def pull_rows(estimate: Mapping[str, Any]) -> list[list[str]]:
    """Return each pull's modulus over the joint one, and the change per day if there is one
    (:mod:`limber.estimation.uncertainty.drift`)."""
    rows = table_of(
        estimate.get("pull_moduli") or [], ("pull", "pull"),
        ("recorded", lambda each: each["recorded"] or "-"), ("E over the joint E", "factor", ".3g"),
        ("95 % interval", lambda each: "{:.3g} to {:.3g}".format(*each["interval"])))
    if rows and (change := estimate.get("drift")):
        low, high = change["interval"]
        rows.append(["change per day", "", f"{100 * change['per_day']:+.2g} %",
                     f"{100 * low:+.2g} to {100 * high:+.2g} %"])
    return rows


def held_out_rows(estimate: Mapping[str, Any]) -> list[list[str]]:
    """Return how well a fit without a pull predicts that pull; numbers not measured are None."""
    scores = estimate.get("held_out") or {}
    return table_of(
        [{"pull": name, **score} for name, score in scores.items()], ("pull", "pull"),
        ("points [mm]", "rms_m", ".2f mm"), ("relative to travel", "relative_distance", ".1f %"),
        ("force [N]", "rms_force_n", ".3g"), ("relative to peak", "relative_force", ".1f %"),
        ("predicted by", lambda score: "the other pulls" if score.get("in_fit", True)
         else "this estimate"), missing="-")


def share_rows(shares: Mapping[str, float]) -> list[list[str]]:
    """Return the fraction of the axes' length that has each state of the radius."""
    return table_of(shares.items(), ("radius", itemgetter(0)),
                    ("fraction of the axes' length", itemgetter(1), ".1f %"))


def order_rows(orders: Sequence[Mapping[str, float]]) -> list[list[str]]:
    """Return branches, length, volume and taper of each branching order, and in total."""
    whole: dict[str, Any] = {name: sum(part[name] for part in orders)
                             for name in ("branch_count", "length_m", "volume_m3")}
    whole["taper"] = sum(part["taper"] * part["length_m"] for part in orders) / max(
        whole["length_m"], 1e-300)
    return table_of(
        [*orders, {**whole, "order": "all"}], ("order", "order"),
        ("branches", "branch_count", ".0f"), ("length [m]", "length_m", ".3f"),
        ("volume [cm3]", "volume_m3", ".1f cm3"),
        ("taper [mm of radius per m]", "taper", ".2f mm"))


def diameter_rows(diameters: Sequence[Mapping[str, float]]) -> list[list[str]]:
    """Return diameters at fractions of the main path's length."""
    return table_of(
        diameters, ("fraction of the main path", "share", ".0f %"),
        ("from the root [m]", "along_m", ".3f"), ("diameter [mm]", "diameter_m", ".2f mm"),
        ("standard deviation [mm]", lambda row: row["sigma_m"] or None, ".2f mm"), missing="-")


def caliper_rows(compared: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return the scan's diameters and those measured with calipers."""
    return table_of(
        compared, ("from the root [m]", "along_m", ".3f"),
        ("calipers [mm]", "measured_m", ".2f mm"), ("scan [mm]", "diameter_m", ".2f mm"),
        ("difference", "difference", "+.1f %"),
        ("in standard deviations", "sigmas", "+.1f"), missing="-")


def edit_rows(effects: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return what edits of a skeleton did: ``do``, ``at`` [3], ``off_m``, ``length_change_m``."""
    return table_of(
        effects, ("edit", "do"), ("took the node at", lambda each: place_text(each["at"])),
        ("off [mm]", "off_m", ".1f mm"), ("length added [mm]", "length_change_m", "+.0f mm"))


def doubtful_rows(doubtful: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return the uncertain parts of a skeleton, as of
    :class:`limber.geometry.skeleton.confidence.Doubt`."""
    value_formats = {"unlikely branch": "probability {:.2f}",
                     "attachment": "probability {:.2f}", "root": "probability {:.2f}",
                     "unresolved radius": "sigma {:.0%} of the radius",
                     "limited radius": "sigma {:.0%} of the radius",
                     "radius jump": "{:.2f} times outwards",
                     "kink": "{:.0f} degrees", "starts backwards": "{:.0f} degrees"}
    edits = {"unlikely branch": "confirm, delete", "unresolved radius": "radius",
             "limited radius": "radius, split (two limbs)", "radius jump": "radius, split",
             "bridged gap": "confirm, bridge", "kink": "move, split", "starts backwards": "bridge",
             "attachment": "bridge", "root": "root"}

    def uncertainty(part: Mapping[str, Any]) -> str:
        angle = part["kind"] in ("kink", "starts backwards")
        value = math.degrees(part["value"]) if angle else part["value"]
        return value_formats.get(part["kind"], "no points").format(value)
    return table_of(
        doubtful, ("what", "kind"), ("branch", "branch"),
        ("at", lambda part: place_text(part["at"])), ("length [mm]", "length_m", ".0f mm"),
        ("radius [mm]", "radius_m", ".2f mm"), ("uncertainty", uncertainty),
        ("edit", lambda part: edits[part["kind"]]))


def alternative_rows(graphs: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return the most likely skeletons, with probability, length [m] and edits, the one in use
    first."""
    used = max(graphs[0]["probability"], 1e-300)

    def differs(graph: Mapping[str, Any]) -> str:
        return "; ".join(" ".join([edit["do"], *(
            f"{name} {place_text(edit[name])}" for name in ("at", "to") if name in edit)])
            for edit in graph["edits"]) or "in use"
    return table_of(
        enumerate(graphs, start=1), ("number", itemgetter(0)),
        ("against the one in use",
         lambda each: f"{each[1]['probability'] / used:.2g} times as likely"),
        ("length [mm]", lambda each: each[1]["length_m"], ".0f mm"),
        ("what differs", lambda each: differs(each[1])))


def _holds(estimate: Mapping[str, Any], number: int, truth: float) -> bool:
    low, high = estimate["young_interval_pa"][number]
    return low is not None and high is not None and bool(low <= truth <= high)


def _mpa(value: float) -> str:
    """Four digits, in the unit of the column [MPa]."""
    return f"{float(f'{value / 1e6:.4g}'):,.10g}"


def _interval(estimate: Mapping[str, Any], number: int) -> str:
    interval = (estimate.get("young_interval_pa") or {number: None})[number]
    if not interval or None in interval:
        return "undetermined"
    return f"{_mpa(interval[0])} to {_mpa(interval[1])}"
