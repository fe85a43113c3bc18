"""Import of image or cloud folders into a pull: PLY files, RGB-D frames in the TUM layout."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from limber.core.constants import UNIT_METRES
from limber.core.errors import InputError, MissingDependencyError, Option, WorkError
from limber.core.files.reading import checked_as, read_json, read_text
from limber.core.files.safe_names import inside
from limber.core.json_values import number_array, validated
from limber.core.numerics.rigid import composed, rotation_matrix
from limber.core.optional import pip_install
from limber.core.progress import SILENT, Progress
from limber.geometry.cloud.camera import Camera, read_camera, read_pixels, write_camera
from limber.geometry.io.clouds import read_points, unit_of
from limber.geometry.io.depth_images import depth_metres

TUM_DEPTH_SCALE = 5000.0
CAMERA_MOVES_M, CAMERA_TURNS_RAD = 3e-3, 0.005
"""Largest motion or rotation of a camera during a pull at which it still counts as fixed."""


def moved_into(frame_pose: ArrayLike, poses: np.ndarray, wrenches: np.ndarray,
               ) -> tuple[np.ndarray, np.ndarray]:
    """Return poses [n, 6] and wrenches about them [n, 6] in the parent frame of ``frame_pose`` [m,
    rad], shape [6], in which they are given."""
    origin, turn = np.split(np.asarray(frame_pose, float), 2)
    known = np.isfinite(poses[:, 3:]).all(axis=1)
    turned = np.full((len(poses), 3), np.nan)
    turned[known] = composed(turn, poses[known, 3:])
    matrix = rotation_matrix(turn).T
    return (np.hstack([origin + poses[:, :3] @ matrix, turned]),
            np.hstack([wrenches[:, :3] @ matrix, wrenches[:, 3:] @ matrix]))


def copy_clouds(source: Path, folder: Path, settings: Any, progress: Progress = SILENT,
                ) -> list[str]:
    """Import PLY files into ``clouds/``, in metres and named by their time stamps; return warnings.
    InputError for fewer than two files, or names without times and no rate."""
    files = sorted(source.glob("*.ply"))
    broken = []
    (folder / "clouds").mkdir(parents=True, exist_ok=True)
    for index, file in enumerate(files):
        progress(index / len(files), "copying clouds")
        try:
            read = read_points(file)
        except InputError:
            # A frame that was being written when the recorder stopped.
            broken.append(file.name)
            continue
        write_frame(folder / "clouds" / f"{_stamp(file, index, settings):.6f}.ply",
                    read.points * UNIT_METRES[unit_of(read, settings.unit)[0]])
    if len(files) - len(broken) < 2:
        raise InputError(f"{source} has {len(files)} PLY files, of which {len(broken)} cannot be "
                         "read.", "At least two frames are needed.",
                         "Give the folder that contains the frames, or record them again.")
    if (source / "camera.toml").exists():
        write_camera(folder / "camera.toml", read_camera(source / "camera.toml"))
    return [f"{len(broken)} PLY file(s) cannot be read and were discarded. The first is "
            f"{broken[0]}."
            ] if broken else []


def write_frame(path: Path, points: np.ndarray) -> None:
    """Write points [m], shape [n, 3], as a binary PLY file in single precision."""
    from plyfile import PlyData, PlyElement

    rows = np.zeros(len(points), [("x", "f4"), ("y", "f4"), ("z", "f4")])
    for axis, values in zip("xyz", points.T, strict=True):
        rows[axis] = values
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))


def copy_rgbd(source: Path, folder: Path, settings: Any, progress: Progress = SILENT,) -> list[str]:
    """Import an RGB-D folder into ``depth/``, ``mask/`` and ``camera.toml``; return warnings.
    ``depth.txt``, ``rgb.txt``, ``mask.txt`` (``timestamp file``) and ``groundtruth.txt``
    (``timestamp tx ty tz qx qy qz qw``) are as in TUM's data; without the lists, file names are
    time stamps. Intrinsics come from ``camera.toml``, else ``calibration.txt`` or
    ``intrinsics.txt`` (fx fy cx cy), else ``camera_intrinsic.json`` (Open3D, RealSense). InputError
    without frames or intrinsics, or if the camera moves."""
    present, warnings = _depth_images(source, settings)
    camera = _camera(source, present[0][1])
    camera, messages = _placed(camera, source, present[0][0], present[-1][0])
    warnings += messages
    write_camera(folder / "camera.toml", camera)
    masks = _masks(source, [stamp for stamp, _ in present], settings)
    depth_metres(present[0][1], camera)  # all frames are of one kind; each is checked when used
    (folder / "depth").mkdir(parents=True, exist_ok=True)
    for index, (stamp, file) in enumerate(present):
        progress(index / len(present), "copying frames")
        shutil.copyfile(file, folder / "depth" / f"{stamp:.6f}.png")
        if masks[index] is not None:
            _write_mask(masks[index], folder / "mask" / f"{stamp:.6f}.png")
    if (source / "background.png").is_file():
        shutil.copyfile(source / "background.png", folder / "background.png")
    mask_count = sum(mask is not None for mask in masks)
    if 0 < mask_count < len(present):
        warnings.append(f"{len(present) - mask_count} of {len(present)} frames have no mask. In "
                        "those frames the branch is segmented by depth alone.")
    return warnings


def _depth_images(source: Path, settings: Any) -> tuple[list[tuple[float, Path]], list[str]]:
    """Time stamps [s] and files of the existing depth images, and warnings."""
    listed = _listed(source, "depth", settings)
    if len(listed) < 2:
        raise InputError(f"{source} has {len(listed)} depth images.",
                         "At least two frames are needed.", "Copy the whole folder.")
    present = [(stamp, file) for stamp, file in listed if file.is_file()]
    missing = f"{len(listed) - len(present)} of {len(listed)} depth images are missing"
    lost = next((file.name for _, file in listed if not file.is_file()), "")
    if len(present) < 0.5 * len(listed):
        raise InputError(f"{source / 'depth.txt'} lists {lost}, which does not exist.",
                         f"{missing}: the recording is incomplete.", "Copy the whole folder.")
    return present, [f"{missing} and were discarded. The first is {lost}."] if lost else []


def tum_list(path: Path) -> list[tuple[float, str]]:
    """Read TUM's ``timestamp value...`` lists; lines with # are comments, an incomplete last line
    is discarded. InputError if a line does not start with a time stamp."""
    if not path.is_file():
        return []
    lines = [line.split(None, 1) for line in read_text(path, "a list of time stamps").splitlines()
             if line.strip() and not line.lstrip().startswith("#")]
    if lines and len(lines[-1]) < 2:
        lines = lines[:-1]
    try:
        entries = [(float(stamp), rest.strip()) for stamp, rest in lines]
        if not np.isfinite([stamp for stamp, _ in entries]).all():
            raise ValueError("a time stamp is not finite")
        return entries
    except ValueError as error:
        raise InputError(f"{path} is not a list of time stamps ({error}).",
                         "Each line is `timestamp file` or `timestamp tx ty tz qx qy qz qw`.",
                         "Correct the file.") from error


def _listed(source: Path, what: str, settings: Any) -> list[tuple[float, Path]]:
    named = [(stamp, _inside(source, file)) for stamp, file in tum_list(source / f"{what}.txt")]
    found = named or [(_stamp(file, index, settings), file) for index, file in enumerate(
        sorted(path for path in (source / what).glob("*") if path.suffix.lower() in
               (".png", ".jpg", ".jpeg")))]
    return sorted(dict(found).items())


def _inside(source: Path, name: str) -> Path:
    """The file named by a list; InputError if it is not in the recording's folder."""
    try:
        return inside(source, name)
    except InputError as error:
        raise InputError(f"A list in {source} contains {name[:100]!r}. {error.seen}",
                         f"{error.why} It may point outside the recording's folder.",
                         f"Correct the list. {error.fix}") from error


def _camera(source: Path, image: Path) -> Camera:
    if (source / "camera.toml").is_file():
        return read_camera(source / "camera.toml")
    height, width = read_pixels(image, "a 16-bit depth image (PNG)").shape[:2]
    for name in ("calibration.txt", "intrinsics.txt", "camera.txt"):
        if (source / name).is_file():
            fx, fy, cx, cy = _four_numbers(source / name)
            return checked_as(source / name, Camera, {
                "width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy,
                "depth_scale": TUM_DEPTH_SCALE}, "fx fy cx cy")
    for name in ("camera_intrinsic.json", "intrinsic.json", "intrinsics.json"):
        if (source / name).is_file():
            return _open3d_camera(source / name)
    raise InputError(f"{source} has no intrinsics.",
                     "Depth images cannot be used without focal length and principal point.",
                     "Write camera.toml (width, height, fx, fy, cx, cy, depth_scale, pose) or "
                     "calibration.txt (fx fy cx cy) beside the images.")


def _four_numbers(path: Path) -> list[float]:
    words = [word for line in read_text(path, "fx fy cx cy").splitlines()
             if not line.lstrip().startswith("#") for word in line.replace(",", " ").split()]
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise InputError(f"{path} contains text that is not a number ({error}).",
                         "fx fy cx cy were expected.", "Correct the file.") from error
    if len(numbers) == 9:
        return [numbers[0], numbers[4], numbers[2], numbers[5]]
    if len(numbers) < 4:
        raise InputError(f"{path} has {len(numbers)} numbers.",
                         "fx fy cx cy, or a 3 x 3 matrix, was expected.", "Correct the file.")
    return numbers[:4]


def _open3d_camera(path: Path) -> Camera:
    try:
        content = read_json(path, "a file of Open3D camera intrinsics")
        matrix = number_array(content["intrinsic_matrix"])
        # Column by column.
        return validated(Camera, {
            "width": content["width"], "height": content["height"], "fx": matrix[0],
            "fy": matrix[4], "cx": matrix[6], "cy": matrix[7],
            "depth_scale": content.get("depth_scale", 1000.0)})
    except (ValueError, KeyError, IndexError, TypeError, OverflowError) as error:
        raise InputError(f"{path} is not a file of Open3D camera intrinsics ({error!r}).",
                         "width, height and intrinsic_matrix (9 numbers) were expected.",
                         "Write camera.toml instead.") from error


def _placed(camera: Camera, source: Path, start: float, end: float) -> tuple[Camera, list[str]]:
    """The camera at its pose in ``groundtruth.txt``, which must be nearly constant."""
    path = source / "groundtruth.txt"
    listed = tum_list(path)
    if not listed:
        return camera, []
    try:
        rows = np.array([[stamp, *map(float, text.split()[:7])] for stamp, text in listed])
        if rows.shape[1] != 8 or not np.isfinite(rows).all():
            raise ValueError("each line needs tx ty tz qx qy qz qw")
        turn = np.linalg.norm(rows[:, 4:], axis=1)
        if not ((turn > 1e-6) & np.isfinite(turn)).all():
            raise ValueError("a quaternion has length 0")
    except ValueError as error:
        raise InputError(f"{path} is not a trajectory ({error}).",
                         "Each line is `timestamp tx ty tz qx qy qz qw`.",
                         "Correct the file.") from error
    nearest = rows[np.argmin(np.abs(rows[:, 0] - start))]
    during = rows[(rows[:, 0] >= start) & (rows[:, 0] <= end)]
    turns = Rotation.from_quat(during[:, 4:]) if len(during) else None
    first = Rotation.from_quat(nearest[4:])
    moved = np.linalg.norm(during[:, 1:4] - nearest[1:4], axis=1).max(initial=0.0)
    turned = float((turns * first.inv()).magnitude().max()) if len(during) else 0.0
    placed = camera.model_copy(update={
        "pose": (*map(float, nearest[1:4]), *map(float, first.as_rotvec()))})
    if moved > CAMERA_MOVES_M or turned > CAMERA_TURNS_RAD:
        raise InputError(
            f"{path}: the camera moves by {moved * 1e3:.0f} mm and {np.degrees(turned):.1f} "
            "degrees during the pull.", "One camera pose is used for all frames.",
            "Keep the camera fixed while the branch is pulled.")
    return placed, []


def _masks(source: Path, stamps: list[float], settings: Any) -> list[Any]:
    """For each frame a mask's file, an array of bool, or None."""
    if settings.yolo_weights:
        return _yolo_masks(source, stamps, settings)
    listed = [(stamp, _inside(source, file)) for stamp, file in tum_list(source / "mask.txt")]
    if not listed:
        # Without a list a mask has its depth image's name.
        depth = dict(_listed(source, "depth", settings))
        named = [source / "mask" / depth[stamp].name for stamp in stamps]
        return [file if file.is_file() else None for file in named]
    return [_nearest(listed, stamp, stamps) for stamp in stamps]


def _nearest(listed: list[tuple[float, Path]], target: float, stamps: list[float],) -> Path | None:
    """The file nearest in time, if it is nearer than half a frame."""
    stamp, file = min(listed, key=lambda entry: abs(entry[0] - target))
    reach = 0.5 * float(np.median(np.diff(stamps))) if len(stamps) > 1 else np.inf
    return file if abs(stamp - target) <= reach and file.is_file() else None


def _yolo_masks(source: Path, stamps: list[float], settings: Any) -> list[Any]:

    images = _listed(source, "rgb", settings)
    if not images:
        raise InputError(f"{source} has no colour images.", "YOLO segments the branch in colour "
                                                            "images.",
                         "Record rgb/ (and rgb.txt), or omit ", Option("yolo_weights"), ".")
    segment = YoloSegmenter(settings.yolo_weights, prompt=settings.yolo_prompt)
    masks: list[np.ndarray | None] = []
    for stamp in stamps:
        file = _nearest(images, stamp, stamps)
        if file is None:
            masks.append(None)
            continue
        pixels = read_pixels(file, "a colour image")
        masks.append(segment(pixels[..., :3] if pixels.ndim == 3 else np.stack([pixels] * 3, -1)))
    return masks


def _write_mask(mask: Any, target: Path) -> None:
    target.parent.mkdir(exist_ok=True)
    if isinstance(mask, Path):
        shutil.copyfile(mask, target)
        return
    from PIL import Image

    Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(target)


def _stamp(file: Path, index: int, settings: Any) -> float:
    if settings.rate_hz is not None:
        return index / settings.rate_hz
    try:
        stamp = float(file.stem)
        if not np.isfinite(stamp):
            raise ValueError("not finite")
        return stamp
    except ValueError as error:
        raise InputError(f"The file name {file.name} is not a time stamp.",
                         "Every frame needs a time.", "Give ", Option("rate_hz"), ".") from error


# Pixels that show the branch: from a file, from depth alone, or from the user's YOLO model.


def segment_by_depth(depth: np.ndarray, *, near: float = 0.2, far: float = 2.0,
                     background: np.ndarray | None = None, difference: float = 0.02,
                     smallest_share: float = 0.05) -> np.ndarray:
    """Return where the branch is, bool [height, width]: large pieces from ``near`` to ``far`` [m],
    and nearer than the background by ``difference`` [m]; depth [m] 0 or NaN is no reading. Pieces
    below a share of the largest are flying pixels; others stay, as a hand or a leaf may split a
    branch."""
    valid = np.isfinite(depth) & (depth > near) & (depth < far)
    if background is not None:
        if background.shape != depth.shape:
            raise InputError(f"The background has shape {background.shape}, the depth image "
                             f"{depth.shape}.",
                             "They must come from the same camera.", "Record the background again.")
        known = np.isfinite(background) & (background > 0)
        valid &= ~known | (depth < background - difference)
    labels, count = scipy.ndimage.label(valid, structure=np.ones((3, 3)))
    if not count:
        return valid
    sizes = np.bincount(labels.ravel())[1:]
    return np.isin(labels, 1 + np.flatnonzero(sizes >= smallest_share * sizes.max()))


class YoloSegmenter:
    """A YOLO segmentation model from a weights file on this computer, through ``ultralytics``; the
    prompt is that of an open-vocabulary model (YOLO-World, YOLOE), such as the paper's "potted
    plant", or one of the classes of another."""

    def __init__(self, weights: Path, *, prompt: str | None = None, confidence: float = 0.25):
        weights = Path(weights)
        if not weights.is_file():
            raise InputError(f"The weights file {weights} does not exist.",
                             "Limber does not download models.",
                             "Give the path of your own YOLO segmentation model.")
        try:
            from ultralytics import YOLO
        except ImportError as error:
            raise MissingDependencyError(
                "The package ultralytics is not installed.", "It is needed to run YOLO models.",
                f"{pip_install('ultralytics')} Or use masks from files, or the built-in "
                "segmenter.") from error
        self._model = YOLO(str(weights))
        self._confidence = confidence
        self._classes = self._chosen_classes(prompt)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the union of the masks found in an image [height, width, 3], as bool."""
        found = self._model.predict(image[..., ::-1], conf=self._confidence, verbose=False,
                                    retina_masks=True, classes=self._classes)[0]
        if found.masks is None:
            return np.zeros(image.shape[:2], bool)
        data = found.masks.data
        masks = data.cpu().numpy() if hasattr(data, "cpu") else np.asarray(data)
        joined = (masks > 0.5).any(axis=0)
        if joined.shape != image.shape[:2]:
            raise WorkError(f"YOLO's masks have shape {joined.shape}, the image "
                            f"{image.shape[:2]}.",
                            "The masks must have the image's size.", "Update ultralytics.")
        return joined

    def _chosen_classes(self, prompt: str | None) -> list[int] | None:
        model: Any = self._model
        if prompt is None:
            return None
        if hasattr(model, "set_classes"):
            model.set_classes([prompt])
            return None
        numbers = [number for number, name in dict(model.names).items() if name == prompt]
        if not numbers:
            raise InputError(f"The model has no class {prompt!r}, and takes no text prompt.",
                             f"Its classes are {', '.join(map(str, dict(model.names).values()))}.",
                             "Select one of these, or use YOLOE.")
        return numbers
