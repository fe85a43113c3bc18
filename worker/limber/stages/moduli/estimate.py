"""Stage ``estimate``."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from limber.core.errors import Cancelled, LimberError, Option, WorkError
from limber.core.json_values import plain
from limber.core.progress import SILENT, Progress
from limber.estimation.settings import EstimateSettings, FitSpec
from limber.stages.result import Numbers, Picture, Result, Table, filled, frozen, of_files, shown
from limber.stages.stage import About, BranchStage, Repeatable, option
from limber.store import Branch

if TYPE_CHECKING:
    from limber.estimation import fit_assessment
    from limber.estimation.estimated_branch import Subject
    from limber.estimation.fitting.objective import EvaluationLog
    from limber.recordings.recording import Pull
    from limber.results.report.section import Section


EVALUATIONS = ".estimate-evaluations.jsonl"
"""File in the branch folder that grows while an estimate runs, and lets a stopped one resume."""


class Estimate(Result):
    """Young's modulus along the branch.

    >>> found = limber.open("a.branch").results["estimate"]
    >>> found.young.shape, found.interval.shape, found.converged
    ((4,), (4, 2), True)
    """

    heading = "Young's modulus along the branch"
    missing = "limber estimate NAME.branch"
    pictures = (Picture("estimate_figures.young_along_branch", "", ("file",)),)
    columns: ClassVar = {
        "fractions": "fraction", "young": "young_pa", "interval": "low_pa high_pa",
        "bending_stiffness": "ei_nm2", "bending_interval": "ei_low_nm2 ei_high_nm2"}

    young: Numbers = shown("Young's modulus", ".4g MPa", interval="interval",
                           meaning="at the control points [Pa], shape [K]")
    poisson: float = shown("Poisson's ratio", ".3f")
    loss: float = shown("loss", ".3g m2", meaning="the paper's loss J [m^2]")
    converged: bool = shown("converged", meaning="whether the fit ended at a solution")
    interval: np.ndarray = of_files("its 95 % interval [Pa], shape [K, 2]; NaN if an end is open")
    bending_stiffness: np.ndarray = of_files(
        "E times the second moment of area [N m^2], the latter a mean around each control point, "
        "as the pulls tell it, shape [K]; NaN in a folder of an earlier version")
    bending_interval: np.ndarray = of_files(
        "its 95 % interval [N m^2], shape [K, 2]: narrower than that of E if the scan leaves the "
        "radius uncertain")
    fractions: np.ndarray = of_files("positions of the control points on the main path, 0 base to "
                                     "1 tip, shape [K]")
    control_points: np.ndarray = of_files("[m], branch frame, shape [K, 3]")
    file: Any = of_files("content of ``estimate.json``")

    def of_folder(self, branch: Branch, key: str) -> dict[str, Any]:
        from limber.estimation.estimate_file import read_estimate

        file = read_estimate(branch.path("estimate.json"))
        count = len(file["young_pa"])
        return {"file": file, "young": frozen(file["young_pa"]), "poisson": file["poisson"],
                "loss": float(frozen(file["loss_m2"])), "converged": file["converged"],
                "interval": frozen(file["young_interval_pa"]),
                "bending_stiffness": frozen(file.get("bending_stiffness_nm2") or [np.nan] * count),
                "bending_interval": frozen(file.get("bending_stiffness_interval_nm2")
                                           or [[np.nan] * 2] * count),
                "fractions": frozen(file["fractions"]),
                "control_points": frozen(file["control_points_m"])}

    def tables(self) -> list[Table]:
        from limber.results.report.report_tables import action_rows, cause_rows, modulus_rows

        return filled(("Young's modulus", modulus_rows(self.values, None)), *self._details(),
                      ("Sources of uncertainty, largest first", cause_rows(self.values)),
                      ("What to do next, best first", action_rows(self.values)))

    def _details(self) -> list[Table]:
        from limber.results.report import report_tables as rows_of

        known = self.file or self.values
        return filled(
            ("Bending stiffness (I: mean of the control point's part)",
             rows_of.rigidity_rows(known)),
            ("Sources of uncertainty: standard deviations",
             rows_of.deviation_rows(known) if "fractions" in known else []),
            ("Modulus by pull", rows_of.pull_rows(known)),
            ("Pulls predicted by a fit without them: RMS errors", rows_of.held_out_rows(known)))

    def sentences(self, branch: Branch) -> list[str]:
        from limber.results import findings

        pull, known = findings.simulated_pull(branch), self.file or self.values
        assumed = findings.ASSUMED_PULL if pull and pull["young_assumed"] else ""
        return [findings.telling_sentence(known), findings.modulus_sentence(known, assumed)]

    def section(self, branch: Branch, key: str) -> Section:
        from limber.results.findings import ASSUMED, simulated_pull
        from limber.results.report.estimate_figures import report_figures
        from limber.results.report.report_tables import is_assumed, modulus_rows
        from limber.results.report.section import Section

        estimate, pull = self.file, simulated_pull(branch)
        title = ("Estimated" if not pull else "Estimated against assumed" if is_assumed(pull)
                 else "Estimated against true")
        section = Section(self.heading, tables=[(title, modulus_rows(estimate, pull)),
                                                *self._details()])
        if is_assumed(pull):
            section.text.append(ASSUMED)
            if estimate.get("truth"):
                estimate["truth"]["assumed"] = True
        section.text.append(
            f"Method: {estimate['method']}; {estimate['forward_count']} forward simulations; "
            f"loss {estimate['loss_m2']:.3g} m²; "
            f"{'converged' if estimate['converged'] else 'NOT converged'}.")
        if error := estimate.get("lumping_error"):
            section.text.append(f"Rigid twigs change the pulls' response by {100 * error:.2g} %.")
        for figure, caption in report_figures(estimate):
            section.draw(figure, caption)
        section.text += estimate.get("warnings", [])
        return section


def _moduli_line(values: Mapping[str, Any]) -> str:
    return "\n".join(Estimate.of(values).sentences(Branch.read(values["branch_folder"])))


class EstimateYoung(EstimateSettings, Repeatable, BranchStage):
    """Estimate Young's modulus along the branch from pulls."""

    about = About(
        "estimate", 70, Estimate, key="estimate", reads=("mesh.vtu", "skeleton.swc", "pulls/"),
        writes=("estimate.json", "mesh.vtu"),
        found=(_moduli_line, "Main cause of the uncertainty: {causes[0][cause]} "
               "({causes[0][share]:share} of the variance). Remedy: {causes[0][advice]}.",
               "Next: {next_actions[0][action]}, {next_actions[0][how]}."),
        then="limber {converged:energy/estimate} {branch_folder}", step="estimate",
        label="Estimate")

    bag: Path | None = option(
        "Import this recording first (MCAP, rosbag2, RTDE log) as a pull with the file's name, and "
        "estimate from it. `limber import-pull` has more options.", group="input", common=True)
    resume: bool = option(
        "Start from the best result of a stopped run. Otherwise that result is ignored.", False,
        switch=True)
    follow: bool = option(
        "Estimate frame by frame while a pull is recorded, or replay one.", False, switch=True)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Estimate Young's modulus from the pulls of a branch folder.

        Writes ``estimate.json`` and the modulus into ``mesh.vtu``. If stopped by Ctrl-C it keeps
        the best result so far in ``estimate.json`` (``converged`` is then false). With ``resume``
        it starts from there, and ends at the same moduli to the fit's tolerance, not to the last
        digit; without it nothing from a stopped or killed run is used. A fit that has spent its
        budget of work leaves the same, with a warning that says how far it was from its end; the
        next run goes on from there.

        Returns:
            DESIGN's keys and ``warnings``.

        Raises:
            InputError: there are no pulls, or pulls that cannot determine Young's modulus.
            WorkError: the simulation finds no equilibrium, or the fit has no result (it did not
                converge, ended at a bound, or the data do not determine the moduli); nothing is
                written.
            Cancelled: the best result so far was kept.
        """
        if self.bag is not None:
            return self._with_bag(self.bag, progress).run(progress)
        if self.follow:
            return follow(self, progress)
        branch = Branch.open(self.branch_folder)
        with branch.writing("limber estimate"):
            return _estimate(branch, self, progress)

    def _with_bag(self, bag: Path, progress: Progress) -> Self:
        """Import a recording; the estimate's pulls are the requested ones and this one."""
        import re

        from limber.stages.pulls.import_pull import ImportPull

        name = re.sub(r"[^A-Za-z0-9_.-]+", "-", bag.stem).strip("-.") or "bag"
        ImportPull(branch_folder=self.branch_folder, source=bag, name=name).run(
            progress.part(0.0, 0.05))
        return self.model_copy(update={
            "pull": tuple(dict.fromkeys((*self.pull, name))), "bag": None})


def _estimate(branch: Branch, asked: EstimateYoung, progress: Progress) -> dict[str, Any]:
    from limber.estimation.estimate_file import details, summary
    from limber.estimation.estimated_branch import lumped, tell_doubts
    from limber.estimation.fit import fit_branch, is_open
    from limber.estimation.fit_assessment import judge_model, require_result
    from limber.estimation.fitting.objective import EvaluationLog
    from limber.recordings.slips import slips_of
    from limber.stages.moduli.other_skeletons import add_other_skeletons
    from limber.store import loading

    names = loading.pull_names(branch, asked)
    settings = loading.fit_spec(branch, asked)
    subject = loading.load_subject(branch, settings)
    digests = {"mesh geometry": subject.mesh.geometry_digest(),
               "pulls": loading.pulls_digest(branch, names)} | loading.wood_digest(branch)
    if asked.is_kept(branch, digests=digests) and (
            stored := branch.manifest.stages["estimate"].result)["converged"]:
        return stored
    warnings: list[str] = []
    heard = progress.keeping(warnings)
    pulls = loading.load_pulls(branch, names, subject, settings, heard.part(0.0, 0.2))
    tell_doubts(pulls, subject, heard)
    for each in [slip for pull in pulls for slip in slips_of(pull, subject.skeleton)]:
        heard.warn(each)
    log_path = branch.folder / EVALUATIONS
    if asked.force:
        log_path.unlink(missing_ok=True)
    log = EvaluationLog(log_path, json.dumps([plain(asked), digests], sort_keys=True),
                        resumes=asked.resume)
    initial, evidence = subject, None
    if is_open(settings):
        pulls = _placed(pulls, initial)
    subject = lumped(subject, pulls, settings)
    if is_open(settings):
        found, settings, subject, evidence = _with_supported_points(
            branch, pulls, subject, settings, log, heard.part(0.2, 0.9))
    else:
        found = fit_branch(pulls, subject, settings, log=log, progress=heard.part(0.2, 0.9))
    found.warnings = warnings
    if not found.fit.is_unfinished:
        require_result(found, subject.skeleton)
        judge_model(found, subject, pulls[0].entry.grasp, settings,
                    axes=branch.path("skeleton.csv") if branch.has("skeleton.csv") else None,
                    cloud=_cloud(branch), progress=heard.part(0.9, 0.95))
        add_other_skeletons(found, branch, _placed(pulls, initial), settings,
                            heard.part(0.95, 0.98))
        if settings.hold_out:
            _score_unused_pulls(branch, names, subject, found, settings, initial, heard)
    elif not found.stopped:
        heard.warn("The fit has not ended: these moduli are no result, and are not in the mesh. "
                   f"{found.fit.reason} Run the estimate again: it goes on from there.")
    result = summary(found, settings) | ({} if evidence is None else {
        "control_point_evidence": evidence, "fractions": settings.initial_fractions})
    earlier = branch.manifest.stages.get("estimate")
    if found.fit.is_unfinished and earlier is not None and earlier.result["converged"]:
        raise (Cancelled if found.stopped else WorkError)(
            f"The fit has not ended. {found.fit.reason}",
            "The finished estimate of an earlier run is kept.",
            "Run it again when there is time for it.")
    with branch.stage("estimate", asked, digests=digests) as stage:
        stage.write("estimate.json", result | details(found, subject, pulls))
        if not found.fit.is_unfinished:
            log.forget()
            whole = loading.load_subject(branch, settings)
            whole.mesh.with_data(cell_data={
                "young": whole.young(found.values),
                "poisson": np.full(whole.mesh.tet_count, found.values.poisson),
                "density": np.full(whole.mesh.tet_count, found.values.density),
            }).write(stage.path("mesh.vtu"))
        stage.result.update(result)
    if found.stopped:
        raise Cancelled("The estimate was stopped.",
                        f"Its best so far (loss {found.fit.evaluation.loss:.3g} m2) is in "
                        "estimate.json, not in the mesh.",
                        "Run it again with ", Option("resume", True), " to start from there.")
    return stage.result


def _with_supported_points(
        branch: Branch, pulls: list[Pull], subject: Subject, settings: FitSpec,
        log: EvaluationLog, progress: Progress,
        ) -> tuple[fit_assessment.Estimate, FitSpec, Subject, dict[int, float] | None]:
    """Fit with as many control points as the pulls support, from a fit with four on; return the
    fit, its settings and branch, and the log evidence by number of control points."""
    from limber.estimation.estimated_branch import lumped
    from limber.estimation.fit import complete, fit_branch, supported
    from limber.estimation.fitting.objective import EvaluationLog, Work
    from limber.store.loading import load_subject

    told: list[str] = []
    first = fit_branch(pulls, subject, settings, log=log, quick=True, work=(work := Work()),
                       progress=progress.part(0.0, 0.7).keeping(told, silently=True))
    found, chosen, model, evidence = first, settings, subject, None
    if first.is_bad is None:
        support = supported(first)
        evidence = support.evidence
        if support.fractions != settings.initial_fractions:
            chosen = settings.model_copy(update={"fractions": support.fractions})
            model = lumped(load_subject(branch, chosen), pulls, chosen)
            heard: list[str] = []
            try:
                second = fit_branch(
                    pulls, model, chosen, log=EvaluationLog(None, ""), quick=True, work=work,
                    near=support.start, known=first.objective.forwards,
                    progress=progress.part(0.7, 0.9).keeping(heard, silently=True))
                if second.stopped or not second.fit.is_unfinished:
                    found, told = second, heard
            except WorkError:
                # Of the two the first has an equilibrium.
                pass
            if found is first:
                chosen, model = settings, subject
    for message in told:
        progress.warn(message)
    complete(found, chosen, progress.part(0.9, 1.0))
    return found, chosen, model, evidence


def _placed(pulls: list[Pull], subject: Subject) -> list[Pull]:
    """Pulls that state where their points are; points without a position are at its control points.
    """
    rest = tuple(map(tuple, subject.control_points.tolist()))
    return [pull if pull.entry.rest_points_m is not None else replace(
        pull, entry=pull.entry.model_copy(update={"rest_points_m": rest})) for pull in pulls]


def follow(asked: EstimateYoung, progress: Progress, training_count: int = 60,
           pace: float = 1.0) -> dict[str, Any]:
    """Estimate frame by frame from the first named pull (or the only one), as it arrives, or
    replayed at ``pace`` times its speed (0: as fast as possible); writes ``estimate-online.json``
    after every frame, `limber estimate` then gives the final result. InputError without such a
    pull, or without markers."""
    from limber.estimation.online.follow import follow as follow_pull
    from limber.store.loading import fit_spec, load_subject

    branch = Branch.open(asked.branch_folder)
    name, where = _followed(branch, asked)
    spec = fit_spec(branch, asked)
    subject = load_subject(branch, spec)
    result, history = follow_pull(
        where, name, subject, spec, pace=pace,
        training_count=training_count, progress=progress,
        axes=branch.path("skeleton.csv") if branch.has("skeleton.csv") else None)
    with branch.stage("estimate-online", asked, digests={"pull": name}) as stage:
        stage.write("estimate-online.json", result | {"history": history})
        stage.result.update(result)
    return stage.result


def _followed(branch: Branch, settings: EstimateSettings) -> tuple[str, Callable[[], Path]]:
    """The pull to follow, and what identifies its folder, which of one that is being recorded is
    not in the manifest, and is another until it has ended."""
    from limber.store.loading import pull_names

    name = settings.pull[0] if settings.pull else None
    if name is not None and branch.growing(f"pulls/{name}") is not None:
        return name, lambda: branch.growing(f"pulls/{name}") or branch.folder / "pulls" / name
    if name is None or not (branch.folder / "pulls" / name / "pull.toml").is_file():
        name = pull_names(branch, settings)[0]
    return name, lambda: branch.path(f"pulls/{name}")


def _cloud(branch: Branch) -> np.ndarray | None:
    from limber.geometry.io.clouds import read_cloud

    if not branch.has("cloud.ply"):
        return None
    cloud = read_cloud(branch.path("cloud.ply"))
    # Leaves give no information on axes and radii.
    return cloud.points[cloud.attributes.get("leaf", np.zeros(len(cloud))) == 0]


def _score_unused_pulls(branch: Branch, names: list[str], subject: Subject,
                        found: fit_assessment.Estimate, settings: FitSpec,
                        initial: Subject, progress: Progress) -> None:
    """Score the branch's pulls that this estimate did not use; ``initial``: the branch with the
    control points where markers without a position are."""
    from limber.estimation.fit_assessment import score_unused
    from limber.store.loading import known_pulls, load_pulls

    for name in [name for name in known_pulls(branch) if name not in names]:
        try:
            pulls = load_pulls(branch, [name], initial, settings)
            score_unused(_placed(pulls, initial)[0], subject, found, settings)
        except LimberError as error:
            progress.warn(
                f"The pull {name}, which the estimate did not use, could not be scored: {error}")
