"""What a pull can determine; computed before the fit."""

import copy
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from limber.core.errors import InputError, Option
from limber.core.numerics.rigid import rotation_matrix
from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.forward.forward_model import Forward
from limber.estimation.forward.solved_pull import QuasiStaticForward
from limber.estimation.parameters import ParameterSpace, Values
from limber.recordings.recording import calibration_of

# Why a measured force does not determine the scale of Young's modulus.

POORER = ((1.0, 0.1), (0.1, 1.0), (0.1, 0.1), (1.0, 0.01), (0.01, 1.0), (0.01, 0.01))
"""Factors on the stated noise, and on zero and drift, that are tried."""
ASTRAY, EXPLAINED = 0.5, 0.9
"""Cosine between the motion that a force would cause and the observed one, below which the force
does not explain it, and above which it does. Chosen."""
ALIKE = 0.02
"""Difference of such cosines below which two frames explain the motion as well."""
CLEAR = 3.0
"""Assumed errors above which the direction of a force is known."""


def too_little_said(objective: Objective, evaluation: Evaluation, limit: float) -> InputError:
    """Return why recorded forces leave the scale of the moduli open: the deviation of log E must be
    below ``limit``."""
    forwards = [forward for forward in objective.forwards if forward.uses_force]
    peaks = [float(np.nanmax(np.linalg.norm(forward.frames.wrenches[:, :3], axis=1)))
             for forward in forwards]
    largest = int(np.argmax(peaks))
    forward = forwards[largest]
    if peaks[largest] == 0:
        return InputError(f"{forward.name}: the recorded force is zero in all frames.",
                          "Then the branch would not have moved.",
                          "Record the gripper's force, and import the recording again.")
    known, noise = calibration_of(forward.entry), forward.entry.sensor.force_sigma_n
    seen = (f"{forward.name}: the force was recorded, up to {peaks[largest]:.3g} N, but it does "
            "not determine the overall scale of Young's modulus.")
    turned = other_frame(forward, objective.space.unpack(evaluation.free))
    hint = "" if turned is None else f" {turned}"
    for by_noise, by_zero in POORER:
        deviation = _scale_deviation(objective, evaluation, by_noise, by_zero)
        if deviation > limit:
            continue
        errors = f"noise {noise:g} N, zero {known.force_bias_sigma_n:.3g} N, drift " \
                 f"{known.force_drift_sigma_n:.3g} N"
        better = [f"the noise to {by_noise * noise:.2g} N (force_sigma_n under [sensor])"
                  ] * (by_noise < 1) + [
                      f"zero and drift to {by_zero * known.force_bias_sigma_n:.2g} N "
                      "(force_bias_sigma_n and force_drift_sigma_n under [calibration])"
                      ] * (by_zero < 1)
        return InputError(
            seen, f"It is small against its assumed errors (standard deviations: {errors}). If you "
            f"know {' and '.join(better)}, the scale is known to {100 * deviation:.0f} %.{hint}",
            f"State the true ones in pulls/{forward.name}/pull.toml, or import the recording with ",
            Option("force_sigma"), " and ", Option("pull_toml"), ". Or pull farther.")
    return InputError(
        seen, "Even with a hundredth of its assumed errors it would not: in the simulation the "
        f"force hardly depends on the modulus.{hint}",
        "Check the columns and the unit of the force, and the grasp point. Then import the "
        "recording again.")


def require_own_frame(objective: Objective, values: Values) -> None:
    """Refuse a force that is far above its errors and clearly given in another frame. The
    InputError says which."""
    for forward in objective.forwards:
        if not forward.uses_force or forward.force_is_stated:
            continue
        known, force = calibration_of(forward.entry), forward.frames.wrenches[:, :3]
        error = np.hypot(known.force_bias_sigma_n, known.force_drift_sigma_n)
        error = np.hypot(error, forward.entry.sensor.force_sigma_n)
        if np.nanmax(np.linalg.norm(force, axis=1)) < CLEAR * error:
            continue
        if (turned := other_frame(forward, values)) is not None:
            raise InputError(
                f"{forward.name}: the force does not belong to the motion.", turned,
                "Give force and torque in the same frame as the gripper's poses and import the "
                "recording again. If both are in another frame than the branch, state its pose (",
                Option("frame_pose"), ", or ", Option("cell"), ").")


def other_frame(forward: Forward, values: Values) -> str | None:
    """Return the frame in which the force would explain the motion, as sentences. None: the force
    explains it as given, or in no frame."""
    if not isinstance(forward, QuasiStaticForward) or forward.entry.drive != "pose":
        return None
    change, at, seen = forward.linear_motion(values)
    change, at = change[:, :3], at[:3]
    own = _cosine(change @ at, seen)
    if own >= ASTRAY:
        return None
    known = np.isfinite(forward.frames.wrenches[:, :3]).all(axis=1)
    by_tool = np.einsum("nij,nj->ni", [rotation_matrix(pose[3:]) for pose in
                                       forward.frames.poses[known]],
                        forward.frames.wrenches[known, :3])
    found = [(_cosine((by_tool - by_tool[0]) @ at, seen), 0.0, "given in the gripper's own axes")]
    for turn in Rotation.create_group("O"):
        size, name = float(turn.magnitude()), f"turned by {_name(turn.as_rotvec())}"
        cosine = _cosine(turn.apply(change) @ at, seen)
        found.append((cosine, size, name))
        found.append((-cosine, size, "with the opposite sign" + (
            "" if size < 0.1 else f" and {name}")))
    best = max(each[0] for each in found)
    if best < EXPLAINED:
        return None
    alike = sorted((size, text) for cosine, size, text in found if cosine > best - ALIKE)
    names = " or ".join(text for _, text in alike[:3])
    return (f"As given, it would move the branch in another direction than it moved (cosine "
            f"{own:.2f}). {names[0].upper()}{names[1:]}, it would move it as observed "
            f"({best:.2f}).")


def _scale_deviation(objective: Objective, evaluation: Evaluation, by_noise: float,
                     by_zero: float) -> float:
    """Standard deviation of the common log E with other errors of the force."""
    forwards, sigmas = [], []
    for forward, sigma in zip(objective.forwards, objective.force_sigma, strict=True):
        other, known = copy.copy(forward), calibration_of(forward.entry)
        other.entry = forward.entry.model_copy(update={
            "calibration": known.model_copy(update={
                "force_bias_sigma_n": by_zero * known.force_bias_sigma_n,
                "force_drift_sigma_n": by_zero * known.force_drift_sigma_n}),
            "sensor": forward.entry.sensor.model_copy(update={
                "force_sigma_n": by_noise * forward.entry.sensor.force_sigma_n})})
        forwards.append(other)
        sigmas.append(by_noise * sigma)
    again = Objective(forwards, objective.space, force_sigma=sigmas).compare(
        evaluation.free, list(evaluation.pulls))
    along = again.slopes[:, :objective.space.group_count].sum(axis=1)
    information = float(along @ along)
    return information**-0.5 if information > 0 else np.inf


def _cosine(one: np.ndarray, other: np.ndarray) -> float:
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.sum(one * other)) / size if size > 0 else 0.0


def _name(turn: np.ndarray) -> str:
    """A rotation by its angle and axis."""
    angle = float(np.linalg.norm(turn))
    axis = turn / max(angle, 1e-12)
    parts = [f"{'-' if part < 0 else ''}{name}" for part, name in zip(axis, "xyz", strict=True)
             if abs(part) > 0.1]
    return f"{np.degrees(angle):.0f} degrees about {' + '.join(parts)}"


UNRESOLVED_DEVIATION = 0.5
"""Deviation of a log E above which the modulus is linked to its neighbour. Chosen."""
SCALE_DEVIATION = 0.7
"""Largest deviation of the common scale of all moduli (in its logarithm) from the data: a factor of
two. Chosen, not measured.
"""


@dataclass(frozen=True)
class Identifiability:
    """Singular values [p], largest first, of standardised residuals to free values, deviations [p],
    and that of the moduli's common scale."""

    singular_values: np.ndarray
    deviations: np.ndarray
    scale_deviation: float


def identifiability(evaluation: Evaluation, space: ParameterSpace) -> Identifiability:
    """Compute the identifiability at an evaluation with derivatives."""
    jacobian = evaluation.slopes
    values = np.linalg.svd(jacobian, compute_uv=False)
    together = np.r_[np.ones(space.group_count), np.zeros(space.size - space.group_count)]
    # Deviation of the scale if the ratios are known: the best possible from the data.
    information = float(np.sum((jacobian @ together)**2))
    return Identifiability(values, evaluation.deviations,
                           float(information**-0.5) if information > 0 else np.inf)


def require_scale(found: Identifiability, objective: Objective, evaluation: Evaluation) -> None:
    """Reject data that do not determine the moduli's scale. InputError says why."""
    if found.scale_deviation <= SCALE_DEVIATION:
        return
    if any(forward.uses_force for forward in objective.forwards):
        raise too_little_said(objective, evaluation, SCALE_DEVIATION)
    raise InputError("These pulls do not determine the overall scale of Young's modulus: twice as "
                     "large moduli would change the measurements by only "
                     f"{0.7 / found.scale_deviation:.1g} standard deviations.", "Without measured "
                     "force, weight or inertia, a branch that moves slowly takes the same shape "
                     "whether it is soft or stiff. A fit would look perfect with every modulus "
                     "wrong.", "Record the gripper's force, or let gravity or inertia act "
                     "(gravity_m_s2 in pull.toml, ", Option("motion", "dynamic"), ").")


def link_unresolved(evaluation: Evaluation, space: ParameterSpace,
                    ) -> tuple[ParameterSpace, list[str]]:
    """Link the moduli that the data leave open to better-known neighbours, the worst first, until
    all others are resolved; a sentence for each link. The two may differ tenfold: as equal, both
    would be wrong, with intervals too narrow."""
    rows = evaluation.slopes[:len(evaluation.slopes) - len(space.links)]
    links: list[tuple[int, int]] = []
    messages = []
    while len(links) < space.group_count - 1:
        own = space.linked(tuple(links)).link_rows()
        deviations = _deviations(np.vstack([rows, own]))[:space.group_count]
        open_ones = deviations.copy()
        open_ones[[group for group, _ in links]] = 0.0
        worst = int(np.argmax(open_ones))
        if open_ones[worst] <= UNRESOLVED_DEVIATION:
            break
        beside = [k for k in (worst - 1, worst + 1)
                  if 0 <= k < space.group_count and (k, worst) not in links]
        if not beside:
            break
        partner = min(beside, key=lambda k: deviations[k])
        links.append((worst, partner))
        messages.append(
            f"These pulls do not determine {space.names[worst]} well: the standard deviation of "
            f"its logarithm is {min(deviations[worst], 99.0):.1f}. The fit therefore assumes that "
            f"it is within a factor of ten of {space.names[partner]}. To determine it, pull at a "
            "point farther out, prescribe the pose, or let gravity bend the tip.")
    return space.linked(tuple(links)), messages


def force_is_measured(objective: Objective) -> bool:
    """Whether the measured force is well above its noise: it determines the scale wherever a fit
    starts. Sensitivities at a start that is far too soft would not show that."""
    for forward, sigma in zip(objective.forwards, objective.force_sigma, strict=True):
        force = forward.frames.wrenches[:, :3]
        if forward.uses_force and np.nanmax(np.abs(force), initial=0.0) > 5 * sigma:
            return True
    return False


def _deviations(jacobian: np.ndarray) -> np.ndarray:
    _, values, rows = np.linalg.svd(jacobian, full_matrices=False)
    spread = rows.T / np.maximum(values, 1e-12 * max(values[0], 1e-300))
    return np.linalg.norm(spread, axis=1)
