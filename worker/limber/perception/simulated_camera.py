"""A depth camera in software: what a D455 would see of a surface, with its noise."""

import numpy as np

from limber.geometry.cloud.camera import Camera, project
from limber.kernels import Kernel


def render_depth(camera: Camera, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Render triangles of ``vertices`` [n, 3] [m], in the branch's frame, into a depth image
    [height, width] [m] without noise; empty pixels are 0."""
    pixels, depth = project(camera, vertices)
    image = np.full((camera.height, camera.width), np.inf)
    _rasterise.of(image, pixels, depth, faces)
    image[~np.isfinite(image)] = 0.0
    return image


def with_noise(camera: Camera, depth: np.ndarray, rng: np.random.Generator, *,
               flying_share: float = 0.05, flying_reach_m: float = 0.15,
               missing_share: float = 0.02) -> np.ndarray:
    """Add to a depth image [m] a stereo camera's noise, sigma = disparity_sigma z^2 / (f b),
    quantised to ``depth_scale``; a share of flying pixels at silhouettes, up to ``flying_reach_m``
    behind the surface; and a share of missing readings (0)."""
    seen = depth > 0
    noisy = depth + seen * camera.depth_sigma(depth) * rng.standard_normal(depth.shape)
    inner = seen.copy()
    inner[1:-1, 1:-1] = seen[:-2, 1:-1] & seen[2:, 1:-1] & seen[1:-1, :-2] & seen[1:-1, 2:]
    edge = np.flatnonzero(seen & ~inner)
    count = min(len(edge), round(flying_share * seen.sum()))
    flying = rng.choice(edge, count, replace=False) if count else edge[:0]
    noisy.ravel()[flying] += flying_reach_m * rng.random(count)
    noisy[rng.random(depth.shape) < missing_share] = 0.0
    return np.round(noisy * camera.depth_scale) / camera.depth_scale


_rasterise = Kernel(
    "rasterise", "out image float64[height, width]", "pixels float64[corners, 2]",
    "depth float64[corners]", "faces int64[faces, 3]")
