"""Stage ``compare``."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from limber.core.errors import Command, InputError, NoPathError, Option, Text
from limber.core.files.tables import table_text
from limber.core.progress import Progress
from limber.core.settings import POSITION, Groups
from limber.core.units import table_of
from limber.planning.settings import PlanSettings
from limber.stages.result import Result, Table, shown
from limber.stages.stage import About, KeptStage, PlacedStage, given
from limber.store import Branch

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from limber.planning.compared_planners import ComparedTrial

_COLUMNS = ("trial", "planner", "length_m", "energy_sum_nmm", "energy_integral_jm", "peak_energy_j")


class Comparison(Result):
    """Planners on the branch's energy field, from random starts."""

    heading = "Planners compared: {name}"

    trial_count: int = shown("random starts", ",")
    planned_count: int = shown("of them planned", ",")
    gap_percent_median: float = shown("median of the gap to the best possible path", ".2g percent",
                                      meaning="median gap to the best possible path")

    def tables(self) -> list[Table]:
        """In the paper's form: each planner against RRT*, mean and deviation over the trials."""
        from limber.planning.compared_planners import BASELINE, COMPARED

        def saved(key: str) -> Callable[[tuple[str, dict[str, Any]]], str]:
            return lambda each: "" if each[0] == BASELINE else f"{each[1][key]:.2f}"
        return [(f"Planners over {self.planned_count} random starts, on the energy field", table_of(
            self.values["planners"].items(), ("branch", lambda _: self.values["branch"]),
            ("planner", lambda each: COMPARED[each[0]]),
            ("path length [m]", lambda each: _spread(each[1], "length_m", ".3f")),
            ("longer [%]", saved("longer_percent")),
            ("deformation energy [N mm]", lambda each: _spread(each[1], "energy_sum_nmm", ".2f")),
            ("saved [%]", saved("saved_percent"))))]


def _saving(values: Mapping[str, Any]) -> str | None:
    """Say what each planner saves against RRT*."""
    from limber.planning.compared_planners import BASELINE, COMPARED

    return "Energy saved against RRT*: " + ", ".join(
        f"{COMPARED[path]} {row['saved_percent']:.1f} %"
        for path, row in values["planners"].items() if path != BASELINE) + "."


class ComparePlanners(KeptStage, PlacedStage):
    """Compare RRT*, D-RRT* and the gentle path over random starts, as the paper does."""

    about = About(
        "compare", 105, Comparison, key="compare:{name}", reads=("energy.npz",),
        writes=("comparisons/{name}.csv", "comparisons/{name}.png"),
        found=("{planned_count} of {trial_count} random starts were planned.", _saving),
        then="limber report {branch_folder}", step="plan", label="Compare Planners")
    groups: ClassVar[Groups] = {"trials": ("trials", "goal", "seed"), "solver": ("max_detour",)}
    common = ("trials", "goal")

    name: str = given("Name of the comparison's files.", "planners", group="output")
    trials: int = Field(10, ge=1, le=1000, description=(
        "Number of random deformed start configurations."))
    goal: tuple[float, float, float] | None = Field(None, description=(
        "Goal position of the grasp, in the branch's frame [m]. Default: the branch's tip within "
        "reach of a second arm, as in the paper."),
                                                    json_schema_extra=POSITION)
    seed: int = Field(0, ge=0, description="Seed of the starts and the planners.")
    max_detour: float | None = Field(8.1, ge=0, le=1000, description=(
        "Largest extra length of the gentle path over that of RRT* [%]. Default: the paper's "
        "mean."))

    def run_in_branch(self, progress: Progress) -> dict[str, Any]:
        """Plan from random starts with each planner, on the branch's energy field.

        Writes ``comparisons/NAME.csv``, one row per path, and ``comparisons/NAME.png``.

        Raises:
            BranchFolderError: there is no energy field.
            InputError: the name is invalid.
            NoPathError: no trial has a path; the message gives the reason.
        """
        from limber.planning.compared_planners import run_trials, summarised
        from limber.planning.field.energy_field import EnergyField
        from limber.planning.goals.goal import grasp_goal
        from limber.planning.goals.goal_kinds import second_arm_goal
        from limber.results.report.figures import planner_figure

        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", self.name):
            raise InputError(Text(Option("name"), f" {self.name!r} cannot name a comparison."),
                             "It becomes part of file names.",
                             "Use letters, digits, dash, dot and underscore.")
        branch = Branch.open(self.branch_folder)
        field = EnergyField.read(branch.require("energy.npz", "energy"))
        reads = ["energy.npz"]
        if self.is_kept(branch, reads=reads):
            return branch.manifest.stages[self.entry].result
        asked = PlanSettings(seed=self.seed, max_detour=self.max_detour)
        goal = (second_arm_goal(field) if self.goal is None
                else grasp_goal(np.array(self.goal), asked.goal_tolerance))
        with branch.stage(self.entry, self, reads=reads) as stage:
            trials = run_trials(field, goal, asked, self.trials, progress=progress)
            good = [trial for trial in trials if trial.scores]
            if not good:
                raise NoPathError(f"None of {len(trials)} trials has a path.", trials[0].trouble,
                                  "Choose another ", Option("goal"), ", or sample more poses with ",
                                  Command("energy", Option("samples")), ".")
            for trial in trials:
                if trial.trouble:
                    progress.warn(f"Trial {trial.number + 1} has no path: {trial.trouble}")
            gaps = [trial.gap_percent for trial in good if trial.gap_percent is not None]
            stage.write(f"comparisons/{self.name}.csv", _rows(good))
            planner_figure(field, good).savefig(stage.path(f"comparisons/{self.name}.png"), dpi=150)
            stage.result.update({
                "goal": goal.describe(), "trial_count": len(trials), "planned_count": len(good),
                "planners": summarised(trials), "gap_percent_median": float(np.median(gaps)),
                "field_energy_error": field.errors["energy_error"],
                "branch": self.branch_folder.stem})
        progress(1.0, "compared")
        return branch.manifest.stages[self.entry].result


def _rows(trials: Sequence[ComparedTrial]) -> str:
    from limber.planning.compared_planners import COMPARED

    return table_text(_COLUMNS, (
        (trial.number + 1, COMPARED[path], *(getattr(score, column) for column in _COLUMNS[2:]))
        for trial in trials for path, score in trial.scores.items()))


def _spread(row: dict[str, Any], key: str, form: str) -> str:
    mean, deviation = row[f"{key}_mean"], row[f"{key}_deviation"]
    return f"{mean:{form}}" if deviation is None else f"{mean:{form}} ± {deviation:{form}}"
