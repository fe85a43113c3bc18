"""One pull's differences of simulated and measured values, each over its standard deviation."""

import numpy as np

from limber.core.not_none import present
from limber.estimation.forward.forward_model import Forward, Simulated
from limber.estimation.forward.input_force import Response
from limber.recordings.synchronisation import Frames


class Residuals:
    """Compares a simulated pull with its measurements.

    Args:
        forward: The pull.
        force_sigma: Standard deviation of its force sensor [N].
    """

    def __init__(self, forward: Forward, force_sigma: float):
        self._forward, frames = forward, forward.frames
        values, vectors = np.linalg.eigh(frames.covariance)
        # Inverse square roots of the covariances, shape [f, m, 3, 3].
        self._whitening = np.einsum("fmij,fmj,fmkj->fmik", vectors, 1 / np.sqrt(values), vectors)
        self._averaged = np.sqrt(np.maximum(frames.wrench_counts, 1))
        self._sigma = force_sigma / self._averaged
        self._span: tuple[Response, np.ndarray, np.ndarray] | None = None

    def points(self, simulated: Simulated) -> np.ndarray:
        """Residuals of the points over their deviations, shape [f, m, 3]; NaN: not observed."""
        off = simulated.positions - self._forward.frames.positions
        return np.einsum("fmij,fmj->fmi", self._whitening, off)

    def forces(self, simulated: Simulated) -> np.ndarray:
        """Residuals of the force over its deviation, shape [f, 3]; NaN: not measured."""
        off = simulated.forces - self._forward.frames.wrenches[:, :3]
        return off / self._sigma[:, None]

    def rows(self, simulated: Simulated) -> tuple[np.ndarray, np.ndarray | None]:
        """All residuals, of points, force, torque and gripper, [r], and their slopes [r, P]."""
        seen, force, torque = self._known(simulated.torques is not None)
        forward = self._forward
        residual = [self.points(simulated)[seen].ravel()]
        if force is not None:
            residual.append(self.forces(simulated)[force].ravel())
        if torque is not None:
            off = simulated.torques - forward.frames.wrenches[:, 3:]
            residual.append((off / self._torque_sigma()[:, None])[torque].ravel())
        if forward.compares_grasp:
            off = simulated.grasps - forward.frames.poses[:, :3]
            residual.append((off / forward.pose_sigma).ravel())
        if simulated.d_positions is None:
            return np.concatenate(residual), None
        return np.concatenate(residual), self.slopes(
            simulated.d_positions, present(simulated.d_forces, "derivative of the force"),
            simulated.d_torques, simulated.d_grasps)

    def slopes(self, points: np.ndarray, forces: np.ndarray, torques: np.ndarray | None,
               grasps: np.ndarray | None) -> np.ndarray:
        """Slopes of the residuals, [r, P], from those of the predicted measurements."""
        seen, force, torque = self._known(torques is not None)
        slope = np.einsum("fmij,fmjp->fmip", self._whitening, points)
        rows = [slope[seen].reshape(-1, slope.shape[-1])]
        if force is not None:
            slope = forces / self._sigma[:, None, None]
            rows.append(slope[force].reshape(-1, slope.shape[-1]))
        if torque is not None:
            slope = torques / self._torque_sigma()[:, None, None]
            rows.append(slope[torque].reshape(-1, slope.shape[-1]))
        if self._forward.compares_grasp:
            slope = present(grasps, "derivative of the grasp's position") / self._forward.pose_sigma
            rows.append(slope.reshape(-1, slope.shape[-1]))
        return np.vstack(rows)

    def kinds(self, simulated: Simulated) -> list[str]:
        """Cause of uncertainty of each residual; length r."""
        seen, force, torque = self._known(simulated.torques is not None)
        kinds = ["noise of the points"] * (3 * int(seen.sum()))
        kinds += ["noise of the force"] * (3 * sum(
            int(known.sum()) for known in (force, torque) if known is not None))
        if self._forward.compares_grasp:
            kinds += ["noise of the gripper's poses"] * (3 * len(self._forward.frames))
        return kinds

    def span(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Orthonormal columns of all changes that the unknowns of the input force can cause, and
        their triangle; None if there are no unknowns.
        """
        response = self._forward.response
        if response is None:
            return None
        if self._span is None or self._span[0] is not response:
            wrenches = response.wrenches
            columns = self.slopes(response.points, wrenches[:, :3],
                                  wrenches[:, 3:] if wrenches.shape[1] == 6 else None,
                                  response.grasps)
            self._span = (response, *np.linalg.qr(columns))
        return self._span[1:]

    def beside(self, rows: np.ndarray) -> np.ndarray:
        """Rows after elimination of the unknown input force."""
        span = self.span()
        return rows if span is None else rows - span[0] @ (span[0].T @ rows)

    def force_change(self, simulated: Simulated) -> np.ndarray:
        """Change of the unknown input force that explains the residuals."""
        columns, triangle = present(self.span(), "response of the pull to its force")
        return -np.linalg.lstsq(triangle, columns.T @ self.rows(simulated)[0], rcond=1e-9)[0]

    def _known(self, has_torque: bool,
               ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """Which points, forces and torques were measured; None: they are not compared."""
        measured = np.isfinite(self._forward.frames.wrenches)
        return (seen_in(self._forward.frames),
                measured[:, :3].all(axis=1) if self._forward.uses_force else None,
                measured[:, 3:].all(axis=1) if has_torque else None)

    def _torque_sigma(self) -> np.ndarray:
        sigma = present(self._forward.entry.sensor.torque_sigma_nm, "deviation of the torque")
        return sigma / self._averaged


def seen_in(frames: Frames) -> np.ndarray:
    """Which points were observed, shape [f, m] of bool."""
    return np.isfinite(frames.positions).all(axis=2)
