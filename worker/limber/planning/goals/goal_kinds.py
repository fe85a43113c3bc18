"""The kinds of goals, and the one requested by a plan's settings."""

from limber.core.errors import InputError
from limber.planning.goals.cell_region import IN_VIEW, SECOND_ARM
from limber.planning.goals.chosen_pose import DRAWN, default_goal
from limber.planning.goals.goal import Goal, GoalKind, GoalRequest
from limber.planning.goals.grasp_goal import AT_PLACE
from limber.planning.goals.target_goal import IN_BALL, IN_BOX
from limber.planning.settings import PlanSettings

KINDS = [AT_PLACE, IN_BALL, IN_BOX, IN_VIEW, SECOND_ARM, DRAWN]
"""An external kind is appended to it."""


def asked_kinds(settings: PlanSettings) -> list[GoalKind]:
    """Return the kinds of goals that settings request."""
    return [kind for kind in KINDS if kind.is_asked(settings)]


def goal_of(request: GoalRequest) -> Goal:
    """Return the requested goal, or a distant pose if there is none.

    Raises:
        InputError: two are requested, or one is invalid.
        NoPathError: there is no far pose.
    """
    settings = request.settings
    asked = asked_kinds(settings)
    if len(asked) > 1:
        raise InputError(f"{' and '.join(kind.option for kind in asked)} are given.",
                         "A path has only one goal.", "Give only one of them.")
    if settings.target is not None and not any(kind.is_of_target for kind in asked):
        *others, last = [kind.option for kind in KINDS if kind.is_of_target]
        raise InputError(f"--target {settings.target} is given without a goal for it.",
                         "A target alone does not state where it must move.",
                         f"Also give {', '.join(others)} or {last}.")
    if not asked:
        return default_goal(request.field, settings.goal_tolerance)
    return asked[0].make(request, getattr(settings, asked[0].name))
