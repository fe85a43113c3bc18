"""Masks from files, from depth and from a YOLO model."""

import sys
import types

import numpy as np
import pytest
from PIL import Image

from limber.core.errors import InputError, MissingDependencyError
from limber.geometry.cloud.camera import read_mask
from limber.recordings.image_folders import YoloSegmenter, segment_by_depth


def test_depth_range_and_small_pieces():
    """What is too near, too far, unread or tiny is not branch; two large pieces both are."""
    depth = np.full((60, 80), 3.0)
    depth[10:50, 20:26] = 1.0
    depth[10:30, 40:46] = 1.1
    depth[5, 70] = 1.0
    depth[2, 2] = 0.05
    depth[20, 22] = 0.0
    mask = segment_by_depth(depth)
    assert mask[12, 21] and mask[15, 43]
    assert not mask[5, 70] and not mask[2, 2] and not mask[0, 0] and not mask[20, 22]


def test_background_difference():
    """With a picture of the empty scene, a wall at the branch's distance is no branch."""
    background = np.full((60, 80), 1.05)
    depth = background.copy()
    depth[10:50, 20:26] = 1.0
    mask = segment_by_depth(depth, background=background)
    assert mask.sum() == 40 * 6
    with pytest.raises(InputError, match="background"):
        segment_by_depth(depth, background=background[:10])


def test_nothing_in_range_is_an_empty_mask():
    """An empty view gives no branch rather than an error: one frame may well be empty."""
    assert not segment_by_depth(np.zeros((20, 30))).any()


def test_mask_file(tmp_path):
    """Nonzero is branch; a file that is no image is an input error."""
    pixels = np.zeros((4, 5), np.uint8)
    pixels[1, 2] = 255
    Image.fromarray(pixels).save(tmp_path / "mask.png")
    assert np.array_equal(read_mask(tmp_path / "mask.png"), pixels > 0)
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(InputError, match="mask"):
        read_mask(tmp_path / "text.png")


class StandInYolo:
    """The part of ultralytics.YOLO that Limber uses, with its shapes."""

    names = {0: "person", 58: "potted plant"}  # noqa: RUF012
    calls: list = []  # noqa: RUF012

    def __init__(self, weights: str):
        self.weights = weights

    def predict(self, image, *, conf, verbose, retina_masks, classes):
        StandInYolo.calls.append(("predict", image[0, 0].tolist(), conf, retina_masks, classes))
        data = np.zeros((2, *image.shape[:2]))
        data[0, 1:3, 1:3] = 0.9
        data[1, 4, 4] = 0.2
        masks = None if conf > 0.9 else types.SimpleNamespace(data=data)
        return [types.SimpleNamespace(masks=masks)]


class StandInYoloE(StandInYolo):
    def set_classes(self, classes):
        StandInYolo.calls.append(("set_classes", classes))


@pytest.fixture
def weights(tmp_path, monkeypatch):
    module = types.ModuleType("ultralytics")
    module.YOLO = StandInYolo
    monkeypatch.setitem(sys.modules, "ultralytics", module)
    StandInYolo.calls = []
    path = tmp_path / "plant.pt"
    path.write_bytes(b"weights")
    return path


def test_yolo_joins_masks_of_the_named_class(weights):
    """Classes go in by number, colours as BGR, masks come back joined and thresholded."""
    segment = YoloSegmenter(weights, prompt="potted plant")
    image = np.zeros((6, 7, 3), np.uint8)
    image[0, 0] = (1, 2, 3)
    mask = segment(image)
    assert mask.sum() == 4 and mask[1, 1] and not mask[4, 4]
    assert StandInYolo.calls == [("predict", [3, 2, 1], 0.25, True, [58])]


def test_yolo_text_prompt_and_nothing_found(weights, monkeypatch):
    """A prompt becomes the model's only class; no detection is an empty mask."""
    monkeypatch.setattr(sys.modules["ultralytics"], "YOLO", StandInYoloE)
    segment = YoloSegmenter(weights, prompt="potted plant", confidence=0.95)
    assert not segment(np.zeros((6, 7, 3), np.uint8)).any()
    assert StandInYolo.calls[0] == ("set_classes", ["potted plant"])


def test_yolo_says_what_is_missing(weights, tmp_path, monkeypatch):
    """No weights, no such class, no package: each its own sentence, and nothing is downloaded."""
    with pytest.raises(InputError, match="does not download models"):
        YoloSegmenter(tmp_path / "none.pt")
    with pytest.raises(InputError, match="potted plant"):
        YoloSegmenter(weights, prompt="oak")
    monkeypatch.setitem(sys.modules, "ultralytics", None)
    with pytest.raises(MissingDependencyError, match="ultralytics"):
        YoloSegmenter(weights)


def test_an_image_that_announces_more_than_it_has(tmp_path):
    """No memory is taken for a part of two gigabytes in a file of a hundred bytes."""
    path = tmp_path / "mask.png"
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(path)
    content = bytearray(path.read_bytes())
    at = content.index(b"IDAT") - 4
    content[at:at + 4] = (2**31 + 43).to_bytes(4, "big")
    path.write_bytes(content)
    with pytest.raises(InputError, match="announces a part"):
        read_mask(path)
