"""A depth camera in software: what a D455 would see of a surface, with its noise."""

import numpy as np

from limber.core.numerics.compiled import compiled_exactly
from limber.geometry.cloud.camera import Camera, project


def render_depth(camera: Camera, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Render triangles of ``vertices`` [n, 3] [m], in the branch's frame, into a depth image
    [height, width] [m] without noise; empty pixels are 0."""
    pixels, depth = project(camera, vertices)
    image = np.full((camera.height, camera.width), np.inf)
    _rasterise(image, pixels, depth, np.ascontiguousarray(faces, np.int64))
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


@compiled_exactly
def _rasterise(image: np.ndarray, pixels: np.ndarray, depth: np.ndarray, faces: np.ndarray) -> None:
    height, width = image.shape
    for face in range(len(faces)):
        a, b, c = faces[face]
        if depth[a] <= 1e-6 or depth[b] <= 1e-6 or depth[c] <= 1e-6:
            continue
        ax, ay = pixels[a]
        bx, by = pixels[b]
        cx, cy = pixels[c]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(area) < 1e-12:
            continue
        left, right = max(int(np.ceil(min(ax, bx, cx))), 0), min(int(max(ax, bx, cx)), width - 1)
        low, high = max(int(np.ceil(min(ay, by, cy))), 0), min(int(max(ay, by, cy)), height - 1)
        for row in range(low, high + 1):
            for column in range(left, right + 1):
                u = ((bx - column) * (cy - row) - (by - row) * (cx - column)) / area
                v = ((cx - column) * (ay - row) - (cy - row) * (ax - column)) / area
                w = 1.0 - u - v
                if u < 0.0 or v < 0.0 or w < 0.0:
                    continue
                # Straight lines in space stay straight in 1/z, not in z.
                z = 1.0 / (u / depth[a] + v / depth[b] + w / depth[c])
                if z < image[row, column]:
                    image[row, column] = z
