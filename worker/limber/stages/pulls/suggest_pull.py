"""Stage ``suggest-pull``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from limber.core.errors import InputError, Option, Text
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups
from limber.core.units import table_of
from limber.estimation.settings import FitSpec
from limber.stages.result import Result, Table, Vector, filled
from limber.stages.stage import About, BranchStage, KeptStage, given
from limber.store import Branch

if TYPE_CHECKING:
    from limber.estimation.estimated_branch import Subject
    from limber.estimation.next_pull import Cell, ExpectedPull, Known, Suggested
    from limber.estimation.parameters import Values

FILE = "suggested_pull.json"
CANDIDATES = (0.5, 0.67, 0.8, 0.92)
"""Candidate grasps as fractions of the main path."""
_CONFIDENCE = 0.95  # of plans made without one
_MATTERS = 1.05  # factor on the usable part of a limit above which a pull changes a plan
_USED = 0.95  # fraction of a limit with the confidence: a nearer plan is held back by it


class SuggestedPull(Result):
    """A pull that would narrow the intervals of Young's modulus."""

    grasp_point: Vector = Field(description="where the gripper holds the branch [m]")
    end: Vector = Field(description="where it moves that to [m]")
    travel: float = Field(gt=0, le=0.5, description="the way [m]")


class SuggestedPulls(Result):
    """The pulls that would narrow the intervals of Young's modulus most."""

    heading = "Suggested pulls"

    best: SuggestedPull = Field(description="the best one")

    def tables(self) -> list[Table]:
        from limber.results.report.report_tables import action_rows

        pulls, plan = [self.values["best"], *self.values["others"]][:8], self.values.get("plan")
        return filled(
            ("Suggested pulls, best first", table_of(
                pulls, ("held at", "grasp_fraction", ".2f"),
                ("to [m]", lambda pull: " ".join(f"{x:.3f}" for x in pull["end_m"])),
                ("travel", lambda pull: f"{1e3 * pull['travel_m']:.0f} mm"),
                ("strain", "peak_strain", ".2g %"),
                ("force", lambda pull: f"{pull['peak_force_n']:.3g} N"),
                ("tells", lambda pull: f"{pull['bits']:.1f} bit"),
                ("per % of strain", lambda pull: f"{pull['bits_per_percent_strain']:.1f} bit"),
                ("E then known within", lambda pull: " ".join(
                    f"{100 * share:.0f} %" for share in pull["young_deviation"])))),
            ("Instead of a pull, best first",
             action_rows({"next_actions": self.values.get("instead")})),
            (f"Worthwhile for the plan {plan['name']}?",
             [["yes" if plan["worth"] else "no"], [plan["why"]]]) if plan else ("", []))


class SuggestPull(KeptStage, BranchStage):
    """Suggest where to hold and how far to pull next to learn most.

    Pulls with several positions, directions and lengths are simulated on the branch as estimated.
    Their information on Young's modulus, with the errors of cell and sensors that the last pull
    stated, is compared with the strain they cause in the branch. With ``--plan`` the result also
    states whether another pull is worthwhile for that plan: whether it would change what the plan
    may do.
    """

    about = About(
        "suggest-pull", 78, SuggestedPulls, key="suggest-pull",
        reads=("mesh.vtu", "skeleton.swc", "estimate.json", "plans/"),
        writes=("suggested_pull.json",),
        found=("Best: hold the branch at {best[grasp_fraction]:.2f} of its main path and move it "
               "by {best[travel_m]:m}, with up to {best[peak_force_n]:N}.",),
        then="limber record {branch_folder} --suggested --cell cell.toml", step="estimate",
        label="Suggest the Next Pull")
    groups: ClassVar[Groups] = {"limits": ("fractions", "max_strain", "max_force")}
    common = ("max_strain", "max_force")

    plan: str | None = given(
        "Name of a plan. The result states whether another pull is worthwhile for it.", common=True)
    fractions: tuple[float, ...] = Field(CANDIDATES, min_length=1, description=(
        "Candidate grasps as fractions of the main path: those that the arm reaches."))
    max_strain: float = Field(0.01, gt=0, lt=1, description=(
        "Largest principal strain during a pull (0.01 is 1 %)."))
    max_force: float | None = Field(None, gt=0, description="Largest force of the gripper [N].")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Write ``suggested_pull.json``: the best pull and others, and the information of each.

        Returns:
            ``best`` and ``others``, each with ``grasp_fraction``, ``grasp_point_m``, ``end_m``,
            ``travel_m``, ``peak_strain``, ``peak_force_n``, ``bits``, ``bits_per_percent_strain``
            and ``young_deviation`` (of log E at the control points, expected after the pull);
            ``most_telling``, the most informative of them; ``instead``, other actions that narrow
            the intervals, as of the estimate; ``young_deviation_now``; ``too_much_count`` and
            ``failed_count``; ``plan`` with ``worth`` and ``why`` if one is named.

        Raises:
            InputError: there is no such plan.
            WorkError: no pull keeps the limits.
        """
        from limber.estimation.next_pull import suggest
        from limber.store.loading import warn_of_assumed_young

        if any(not 0.0 < fraction <= 1.0 for fraction in self.fractions):
            raise InputError(Text(Option("fractions", self.fractions), "."),
                             "Grasps are fractions of the main path's length.",
                             "Give numbers greater than 0 and at most 1.")
        branch = Branch.open(self.branch_folder)
        branch.require("mesh.vtu", "reconstruct")
        reads = [file for file in ("mesh.vtu", "skeleton.swc", "estimate.json") if branch.has(file)]
        if self.plan is not None:
            branch.require(f"plans/{self.plan}.json", "plan")
            reads.append(f"plans/{self.plan}.json")
        if self.is_kept(branch, reads=reads):
            return branch.manifest.stages["suggest-pull"].result
        with branch.stage("suggest-pull", self, reads=reads) as stage:
            subject, values, known = _state(branch)
            warn_of_assumed_young(branch, values.young, progress)
            cell = _cell(branch)
            most = np.inf if self.max_force is None else self.max_force
            found = suggest(subject, values, known, cell, self.fractions, max_force=most,
                            max_strain=self.max_strain,
                            progress=progress.part(0.0, 0.8))
            stage.result.update(_summary(found, known) | {"instead": _instead(branch)})
            if self.plan is not None:
                progress(0.8, "the plan under other moduli")
                stage.result["plan"] = {"name": self.plan} | _for_plan(
                    branch, self.plan, known, known.after(found.pulls[0].information),
                    progress.part(0.8, 1.0))
            stage.write(FILE, stage.result)
        return branch.manifest.stages["suggest-pull"].result


def _state(branch: Branch) -> tuple[Subject, Values, Known]:
    """Return the branch, its moduli if known, and their uncertainty."""
    from dataclasses import replace

    from limber.estimation.estimate_file import read_estimate
    from limber.estimation.next_pull import Known
    from limber.store.loading import load_estimated_subject, load_subject

    if not branch.has("estimate.json"):
        subject = load_subject(branch, FitSpec())
        form = () if subject.field is None else subject.field.names
        return subject, subject.start, Known.nothing(len(subject.control_points), len(form))
    found = read_estimate(branch.path("estimate.json"))
    subject = load_estimated_subject(branch, found, gravity=True)
    values = replace(
        subject.start, young=np.array(found.get("young_mesh_pa") or found["young_pa"], float),
        poisson=found["poisson"], density=found.get("density") or subject.start.density,
        form=tuple(found.get("field_form") or ()))
    return subject, values, Known.estimated(found)


def _instead(branch: Branch) -> list[dict[str, Any]]:
    """Return what else would narrow the intervals, according to the estimate."""
    from limber.estimation.estimate_file import read_estimate
    from limber.estimation.uncertainty.next_actions import ANOTHER_PULL

    if not branch.has("estimate.json"):
        return []
    found = read_estimate(branch.path("estimate.json"))
    return [each for each in found.get("next_actions") or [] if each["action"] != ANOTHER_PULL]


def _cell(branch: Branch) -> Cell:
    """Return the cell's data in the last recorded pull, and its number of frames."""
    from limber.estimation.next_pull import Cell
    from limber.recordings.recording import read_pull
    from limber.store.loading import known_pulls

    names = known_pulls(branch)
    return Cell.of(read_pull(branch.path(f"pulls/{names[-1]}")) if names else None)


def _summary(found: Suggested, known: Known) -> dict[str, Any]:
    best, *others = [_entry(pull, known) for pull in found.pulls]
    most = max(range(len(found.pulls)), key=lambda k: found.pulls[k].bits)
    return {"best": best, "others": others, "most_telling": [best, *others][most],
            "young_deviation_now": np.sqrt(np.diag(known.total)),
            "too_much_count": len(found.too_much), "failed_count": found.failed_count}


def _entry(pull: ExpectedPull, known: Known) -> dict[str, Any]:
    return {"grasp_fraction": pull.choice.fraction, "grasp_point_m": pull.point,
            "end_m": pull.end, "travel_m": float(np.linalg.norm(pull.end - pull.point)),
            "peak_strain": pull.peak_strain, "peak_force_n": pull.peak_force, "bits": pull.bits,
            "bits_per_percent_strain": pull.bits_per_percent,
            "young_deviation": np.sqrt(np.diag(known.after(pull.information).total))}


def _for_plan(branch: Branch, name: str, now: Known, after: Known, progress: Progress,
              ) -> dict[str, Any]:
    """Return whether a pull changes what a plan may do, and why."""
    from limber.planning.constraints.limits import limits_in_file
    from limber.planning.path_on_full_model import resolve_path
    from limber.planning.plan_file import read_plan
    from limber.stages.paths.plan_uncertainty import estimated_uncertainty
    from limber.store.loading import load_grasp_model

    plan = read_plan(branch.path(f"plans/{name}.json"))
    limits = limits_in_file(plan.summary.get("limits") or {})
    confidence = branch.manifest.stages[f"plan:{name}"].settings.get("confidence") or _CONFIDENCE
    if not limits.asked():
        return {"worth": False, "why": "The plan has no limits, so a better known modulus changes "
                "nothing about it."}
    gravity = bool(branch.manifest.stages["energy"].settings.get("gravity", True))
    grasp_model = load_grasp_model(branch, gravity=gravity, progress=progress)
    uncertainty = estimated_uncertainty(branch, grasp_model)
    if uncertainty is None:
        return {"worth": True, "why": "There is no estimate, so it is unknown whether the plan "
                "keeps its limits."}
    phases = np.array(plan.motion.phases)
    positions = plan.motion.poses[:, :3]
    path = resolve_path(grasp_model, positions[phases == "path"],
                        np.vstack([positions[phases == "approach"],
                                   positions[phases == "path"][:1]]),
                        progress.part(0.0, 0.4)).require()
    exposure = uncertainty.exposure(grasp_model, path, limits, progress.part(0.4, 1.0))
    before, then = (exposure.risk(each.total, confidence) for each in (now, after))
    worth, why = verdict(before, then, confidence)
    return {"worth": worth, "why": why, "confidence": confidence, "kept_now": before.kept,
            "kept_after": then.kept, "share_of_limits_now": before.excess,
            "share_of_limits_after": then.excess}


def verdict(now: Any, after: Any, confidence: float) -> tuple[bool, str]:
    """Return whether a pull between two :class:`limber.planning.constraints.chance.Risk` is
    worthwhile for a plan, and why."""
    over = [name for name, share in now.excess.items() if share > 1.0]
    sure = f"with a confidence of {confidence:g}"
    if over:
        still = [name for name in over if after.excess[name] > 1.0]
        named = ", ".join(over).replace("_", " ")
        if len(still) < len(over):
            return True, (f"The plan does not keep {named} {sure}. After this pull it is expected "
                          "to.")
        return True, Text(f"The plan does not keep {named} {sure}, and is not expected to after "
                          "one more pull either. Also plan again with ", Option("confidence"), ".")
    gained = {name: now.factors[name] / after.factors[name] for name in now.factors
              if now.excess[name] > _USED}
    if not gained:
        return False, (f"The plan keeps its limits {sure}, and none of them restricts it. A "
                       "better known modulus changes nothing.")
    name, ratio = max(gained.items(), key=lambda item: item[1])
    words = name.replace("_", " ")
    if ratio > _MATTERS:
        return True, (f"The plan keeps its limits {sure}, and {words} restricts it. After this "
                      f"pull {100 * (ratio - 1):.0f} % more of that limit could be used.")
    return False, (f"The plan keeps its limits {sure}, and {words} restricts it. This pull would "
                   f"make only {100 * (ratio - 1):.1f} % more of that limit usable.")
