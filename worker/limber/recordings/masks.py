"""Pixels that show the branch: from a file, from depth alone, or from the user's YOLO model.
"""

from pathlib import Path
from typing import Any

import numpy as np
import scipy

from limber.core.errors import InputError, MissingDependencyError, WorkError
from limber.core.optional import pip_install


def segment_by_depth(depth: np.ndarray, *, near: float = 0.2, far: float = 2.0,
                     background: np.ndarray | None = None, difference: float = 0.02,
                     smallest_share: float = 0.05) -> np.ndarray:
    """Find the branch without a model: large foreground pieces.

    Args:
        depth: [m], shape [height, width]; 0 or NaN: no reading.
        near: Smallest depth [m].
        far: Largest depth [m].
        background: Depth without the branch [m]; pixels nearer by ``difference`` are foreground.
        difference: [m].
        smallest_share: Pieces smaller than this fraction of the largest are discarded as flying
            pixels. Other large pieces are kept, since a hand or a leaf may split a branch in two.

    Returns:
        True on the branch, shape [height, width]; all False if nothing is in range.
    """
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
    """A YOLO segmentation model from a weights file on this computer, through ``ultralytics``.

    With ``prompt`` the model must be an open-vocabulary one (YOLO-World, YOLOE); the paper's prompt
    was "potted plant". Otherwise ``class_name`` selects one of the model's own classes.
    """

    def __init__(self, weights: Path, *, prompt: str | None = None, class_name: str | None = None,
                 confidence: float = 0.25):
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
        self._classes = self._chosen_classes(prompt, class_name)

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

    def _chosen_classes(self, prompt: str | None, class_name: str | None) -> list[int] | None:
        model: Any = self._model
        if prompt is not None:
            if not hasattr(model, "set_classes"):
                raise InputError("This YOLO model does not accept a text prompt.",
                                 "Its classes are fixed.",
                                 "Select one of its classes, or use YOLOE.")
            model.set_classes([prompt])
            return None
        if class_name is None:
            return None
        numbers = [number for number, name in dict(model.names).items() if name == class_name]
        if not numbers:
            raise InputError(f"The model has no class {class_name!r}.",
                             f"Its classes are {', '.join(map(str, dict(model.names).values()))}.",
                             "Select one of these.")
        return numbers
