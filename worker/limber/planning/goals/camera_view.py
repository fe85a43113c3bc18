"""The view of a fixed camera, and occlusion of a target in it."""

from dataclasses import dataclass

import numpy as np

from limber.planning.goals.regions import Convex, position_text


@dataclass(frozen=True)
class View(Convex):
    """The view of a pinhole camera within a range of distances along its axis.

    Attributes:
        frame: Frame of the camera in the branch's: x right, y down, z ahead, shape [4, 4].
        slopes: x / z and y / z at the picture's borders: left, right, top, bottom.
        range_m: Least and greatest z [m].
    """

    frame: np.ndarray
    slopes: tuple[float, float, float, float]
    range_m: tuple[float, float]

    @property
    def planes(self) -> np.ndarray:
        left, right, top, bottom = self.slopes
        near, far = self.range_m
        own = np.array([[-1, 0, left, 0], [1, 0, -right, 0], [0, -1, top, 0], [0, 1, -bottom, 0],
                        [0, 0, -1, near], [0, 0, 1, -far]], float)
        own /= np.linalg.norm(own[:, :3], axis=1, keepdims=True)
        normals = own[:, :3] @ self.frame[:3, :3].T
        return np.column_stack([normals, own[:, 3] - normals @ self.frame[:3, 3]])

    @property
    def corners(self) -> np.ndarray:
        left, right, top, bottom = self.slopes
        own = np.array([[x * z, y * z, z] for z in self.range_m for x in (left, right)
                        for y in (top, bottom)])
        return own @ self.frame[:3, :3].T + self.frame[:3, 3]

    @property
    def words(self) -> str:
        near, far = self.range_m
        return (f"the image of the camera at {position_text(self.frame[:3, 3])} m that looks along "
                f"{position_text(self.frame[:3, 2])}, {near:.3f} to {far:.3f} m ahead of it")

    def describe(self) -> dict:
        return {"camera_m": self.frame[:3, 3].tolist(), "axis": self.frame[:3, 2].tolist(),
                "range_m": list(self.range_m)}

    def hidden_by(self, triangles: np.ndarray, point: np.ndarray, slack: float) -> bool:
        """Return whether a surface is between the camera and ``point`` [3].

        ``triangles`` are [f, 3, 3]; surface within ``slack`` [m] of the position belongs to it.
        Moeller and Trumbore 1997.
        """
        eye = self.frame[:3, 3]
        ray = np.asarray(point, float) - eye
        first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
        across = np.cross(ray, second)
        volume = np.einsum("ij,ij->i", first, across)
        # A triangle that the ray lies in hides nothing; rounding would give it a place anywhere.
        size = np.linalg.norm(first, axis=1) * np.linalg.norm(across, axis=1)
        safe = np.where(np.abs(volume) > 1e-9 * size + 1e-30, volume, np.inf)
        to_eye = eye - triangles[:, 0]
        u = np.einsum("ij,ij->i", to_eye, across) / safe
        turned = np.cross(to_eye, first)
        v = (turned @ ray) / safe
        t = np.einsum("ij,ij->i", second, turned) / safe
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        return bool((hit & (t < 1.0 - slack / np.linalg.norm(ray))).any())
