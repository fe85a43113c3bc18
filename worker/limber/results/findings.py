"""Findings as sentences that report, scene and terminal share."""

from collections.abc import Mapping, Sequence
from math import exp, inf, log
from pathlib import Path
from typing import Any

from limber.cell.known_arms import arm_named
from limber.cell.ur_arms import ARMS
from limber.core.constants import STANDARD_GRAVITY
from limber.core.errors import InputError
from limber.planning.constraints.damage import assumed, assumed_strain
from limber.store import Branch

ASSUMED = ("This branch was not pulled, so the modulus of the simulated pull is assumed. The "
           "estimate shows only that the assumed modulus is recovered. It states nothing about "
           "the real branch.")
ASSUMED_PULL = "from a simulated pull with an assumed modulus"
_MOST_NAMED = 6
"""Most control points whose moduli are listed one by one in a sentence."""
SAME = 0.05
"""Largest difference of energy and length [%] at which two paths count as one."""
PATH_NAMES = {"baseline": "shortest", "plan": "gentle"}
"""Names of the two paths of a plan in text, tables and figures."""


def simulated_pull(branch: Branch) -> dict[str, Any] | None:
    """Return the result of a branch's first simulated pull; None if all pulls were measured.
    ``young_assumed`` is set if the branch was not generated and its modulus is unknown."""
    stages = branch.manifest.stages
    found = [stages[key].result for key in (f"pull:{name}" for name in branch.names("pulls"))
             if key in stages and stages[key].result.get("young_true_pa") is not None]
    return found[0] | {"young_assumed": not branch.has("truth/truth.json")} if found else None


def modulus_origin(branch: Branch) -> str:
    """Return the source of the mesh's modulus: in colours an assumed one looks like an estimate."""
    made = branch.manifest.files.get("mesh.vtu")
    if made is None or made.stage in ("reconstruct", "mesh"):
        return "assumed"
    pull = simulated_pull(branch) if made.stage == "estimate" else None
    return "assumed, from a simulated pull" if pull and pull["young_assumed"] else "estimated"


def modulus_sentence(estimate: Mapping[str, Any], assumed: str = "") -> str:
    """Return the moduli from base to tip with their intervals [Pa], None where open; ``assumed``:
    what the reader must know first, empty for a real pull."""
    intervals = estimate.get("young_interval_pa") or [None] * len(estimate["young_pa"])
    told = [(young, _with_interval(young, interval)) for young, interval in zip(
        estimate["young_pa"], intervals, strict=True)]
    words = "from base to tip" if estimate.get("converged", True) else "so far"
    if len(told) > _MOST_NAMED:
        told = sorted(told)[::len(told) - 1]
        words = "between the lowest and the highest control point"
    return (f"Young's modulus {words}: {', '.join(each for _, each in told)} MPa (95 % intervals"
            f"{f'; {assumed}' if assumed else ''}).")


def telling_sentence(estimate: Mapping[str, Any]) -> str:
    """Return which of E and E I the pulls tell, to how much, and what that is good for."""
    if not estimate.get("converged", True):
        return "The fit has not ended: these pulls tell nothing yet."
    wide = sorted((max(log(each[1] / each[0]) / 2 if each and all(each) else inf
                       for each in estimate[key]), name)
                  for key, name in (("young_interval_pa", "Young's modulus E"),
                                    ("bending_stiffness_interval_nm2", "the bending stiffness E I"))
                  if estimate.get(key))
    best, worst = wide[0][0], wide[-1][0]
    both = ("" if len(wide) < 2 else " Both follow alike." if best > 0.8 * worst else
            " The rest of E's uncertainty is the radius of the scan. Forces, energies and plans "
            "need E I alone.")
    told = " and ".join(
        f"{name} with no limit" if size == inf else f"{name} to within a factor of {exp(size):.2g}"
        if size > 0.5 else f"{name} to within {100 * size:.0f} %" for size, name in wide)
    return f"These pulls tell {told}: {next(use for limit, use in _USES if best <= limit)}.{both}"


_USES = ((0.2, "good for plans and forces"), (0.5, "good for plans, and for forces with a margin"),
         (1.0, "good for comparing branches and for a first plan with a wide margin"),
         (inf, "only an order of magnitude, and no plan should rely on it"))
"""By the half width of the better known one's logarithm, of 95 %. Chosen."""


def plan_sentences(plan: Mapping[str, Any]) -> list[str]:
    """Return what was found by a plan, by its summary."""
    return [text for find in (path_sentence, certificate_sentence, beyond_sentence)
            if (text := find(plan))]


def path_sentence(plan: Mapping[str, Any]) -> str:
    """Return the probability that the gentle path damages the branch, as far as it is known, its
    length, energy and force, and its savings, by a plan's summary."""
    gentle, strength = plan["plan"], plan.get("strength") or {}
    known = ((strength.get("damage_probability"), 100.0,
              "damages the branch with a probability of {:.2g} %"),
             (gentle["length_m"], 1e3, "is {:.3g} mm long"),
             (gentle.get("peak_energy_j"), 1e3, "stores at most {:.3g} mJ"),
             (gentle.get("peak_force_n"), 1.0, "needs at most {:.3g} N"))
    sentence = "The gentle path " + _listed([
        words.format(factor * value) for value, factor, words in known if value is not None])
    saved, added = plan.get("energy_saved_percent"), plan.get("length_added_percent")
    if saved is None or added is None:
        return f"{sentence}."
    if max(abs(saved), abs(added)) < SAME:
        return f"{sentence}; no shorter one was found."
    return (f"{sentence}; it saves {saved:.3g} % of the shortest path's energy for {added:+.2g} % "
            "of length.")


def certificate_sentence(plan: Mapping[str, Any]) -> str:
    """Return how far a plan's cost can be above the optimum, or within an allowed length its
    energy, and what is proven of it."""
    certificate, detour = plan.get("certificate") or {}, plan.get("detour")
    quantity = "energy along the path" if detour else "cost"
    gaps = [(certificate.get("gap_percent"), "on the energy field (proven)"),
            ((certificate.get("full_model") or {}).get("gap_percent"),
             "on the full model, by the field's error at 95 % of the samples,")]
    known = [f"{gap:.1f} % {where}" for gap, where in gaps if gap is not None]
    if not known:
        return f"No bound on its {quantity} is proven."
    least = (f"that of the gentlest path no longer than {1e3 * detour['longest_m']:.3g} mm"
             if detour else "the least possible")
    return f"Its {quantity} is at most {' and '.join(known)} above {least}."


def remarks_on(plan: Mapping[str, Any]) -> dict[str, str]:
    """Return the limits of arm (``robot``) or wood (``strength``: the strain at which half of such
    branches break, and its source) that a plan's paths exceed, as sentences by ``peak_force_n`` and
    ``peak_strain``."""
    found = {}
    for key, over in (("peak_force_n", _over_arm), ("peak_strain", _over_wood)):
        remarks: dict[str, list[str]] = {}
        for path, name in PATH_NAMES.items():
            if (plan.get(path) or {}).get(key) is not None and (words := over(path, plan)):
                remarks.setdefault(words, []).append(name)
        if remarks:
            found[key] = "; ".join(f"{' and '.join(names)}: {words}"
                                   for words, names in remarks.items())
    return found


def beyond_sentence(plan: Mapping[str, Any]) -> str:
    """Return sentences on the limits of arm or wood that a plan's paths exceed; empty if none."""
    labels = {"peak_force_n": "Peak force", "peak_strain": "Largest strain"}
    return " ".join(f"{labels[key]}, {words}." for key, words in remarks_on(plan).items())


def force_remark(force: float, model: str | None = None) -> str:
    """State which arm, by name or file, cannot apply a force [N]; None: the strongest known one
    that cannot. Empty if all can."""
    try:
        arms = [arm_named(model)] if model else list(ARMS.values())
    except InputError:
        # The arm's file, or the package that provides the arm, is on another computer.
        return ""
    weak = [arm for arm in arms if force > arm.payload * STANDARD_GRAVITY]
    if not weak:
        return ""
    arm = max(weak, key=lambda each: each.payload)
    return (f"more than a {Path(arm.name).stem.upper()} carries "
            f"({arm.payload * STANDARD_GRAVITY:.0f} N)")


def strain_remark(strain: float, strength: Mapping[str, Any]) -> str:
    """State that a largest principal strain breaks half of such branches, else "", by
    ``median_strain`` and ``source`` of
    :meth:`limber.planning.constraints.damage.Strength.describe`."""
    if strain <= strength["median_strain"]:
        return ""
    return (f"over the {100 * strength['median_strain']:.2g} % at which half of such branches "
            f"break ({strength['source']})")


def peaks_line(peaks: Mapping[str, Any], model: str | None = None) -> str:
    """Return ``peak_strain`` and ``peak_force_n`` [N] (0: no gripper) of a motion, each with the
    limit that it exceeds; ``model``: the arm; ``young_median_pa`` says whether a strength is
    assumed."""
    strain, force = peaks["peak_strain"], peaks.get("peak_force_n")
    of_wood = assumed_strain(peaks.get("young_median_pa") or 0.0) is not None
    parts = [("Largest strain", f"{100 * strain:.2g} %",
              strain_remark(strain, assumed(strain)) if of_wood else "")]
    if force:
        parts.append(("peak force", f"{force:.3g} N", force_remark(force, model)))
    return "; ".join(f"{name} {value}" + (f", {remark}" if remark else "")
                     for name, value, remark in parts) + "."


def _over_arm(path: str, plan: Mapping[str, Any]) -> str:
    return force_remark(float(plan[path]["peak_force_n"]), (plan.get("robot") or {}).get("model"))


def _over_wood(path: str, plan: Mapping[str, Any]) -> str:
    strength = plan.get("strength")
    return strain_remark(plan[path]["peak_strain"], strength) if strength else ""


def _with_interval(young: float, interval: Sequence[float | None] | None) -> str:
    low, high = interval or (None, None)
    if low is None or high is None:
        return f"{_mpa(young)} (not determined)"
    return f"{_mpa(young)} ({_mpa(low)} to {_mpa(high)})"


def _mpa(value: float) -> str:
    """Three digits [MPa], without an exponent."""
    return f"{float(f'{value / 1e6:.3g}'):,.10g}"


def _listed(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
