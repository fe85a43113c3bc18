"""A Blender with a window on a screen of its own: driven by a script, its pictures taken."""

import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from PIL import Image, ImageGrab, features

FOLDER = Path(__file__).parent


def require_screen() -> None:
    if shutil.which("Xvfb") is None:
        pytest.skip("NO Xvfb: scripts/provision_blender --gui-test brings it")
    if not features.check("xcb"):
        pytest.skip("NO pictures of screens in this Pillow")


def driven(script: str, blender: str, environment: dict[str, str], folder: Path,
           size: tuple[int, int] = (1280, 800), seconds: float = 240.0) -> dict:
    """Run a script that drives a Blender of its own in a window as large as the screen, until that
    is closed; return what it has seen.
    """
    with virtual_screen(size) as display, _window(script, blender, environment, folder, size,
                                                  display) as process:
        _take_pictures(folder, display, seconds, lambda: process.poll() is not None)
    return _seen(folder, folder)


class SharedBlender:
    """A Blender with a window in which one script runs after another; a context manager.

    Each begins as Blender starts. Where one fails, the next gets another Blender.
    """

    size = (1280, 800)

    def __init__(self, blender: str, environment: dict[str, str], folder: Path):
        self._open = lambda display: _window("drive_cases.py", blender, environment, folder,
                                             self.size, display)
        self._folder = folder
        self._stack = ExitStack()

    def __enter__(self) -> "SharedBlender":
        self._display = self._stack.enter_context(virtual_screen(self.size))
        self._blender = ExitStack()
        self._process: subprocess.Popen | None = None
        return self

    def __exit__(self, *_exception: object) -> None:
        self._blender.close()
        self._stack.close()

    def driven(self, script: str, folder: Path, seconds: float = 240.0) -> dict:
        """Run a script; return what it has seen."""
        if self._process is None:
            self._blender.close()
            self._process = self._blender.enter_context(self._open(self._display))
        process, self._process = self._process, None
        asked = self._folder / "case.new"
        asked.write_text(json.dumps({"script": script, "folder": str(folder)}))
        asked.rename(self._folder / "case.json")
        _take_pictures(folder, self._display, seconds,
                       lambda: (folder / "log.json").is_file() or process.poll() is not None)
        seen = _seen(folder, self._folder)
        self._process = process
        return seen


@contextmanager
def _window(script: str, blender: str, environment: dict[str, str], folder: Path,
            size: tuple[int, int], display: str) -> Iterator[subprocess.Popen]:
    with (folder / "said.txt").open("w") as said, subprocess.Popen(
            [blender, "--enable-event-simulate", "--window-geometry", "0", "0", *map(str, size),
             "--python", str(FOLDER / script), "--", str(folder)],
            # Software draws, on one core: others have the rest.
            env=environment | {"DISPLAY": display, "LP_NUM_THREADS": "0"},
            stdout=subprocess.DEVNULL, stderr=said) as process:
        try:
            yield process
        finally:
            process.kill()


def _seen(folder: Path, window: Path) -> dict:
    """What a script has seen; ``window`` is the folder with what its Blender said."""
    assert (folder / "log.json").is_file(), (window / "said.txt").read_text()[-2000:]
    seen = json.loads((folder / "log.json").read_text())
    assert seen["error"] is None, seen
    return seen


@contextmanager
def virtual_screen(size: tuple[int, int]) -> Iterator[str]:
    """A screen of this width and height without a monitor; gives its DISPLAY."""
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "{}x{}x24".format(*size), "-nolisten",
         "tcp"],
        pass_fds=[write], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    os.close(write)
    try:
        with os.fdopen(read) as stream:
            yield f":{stream.readline().strip()}"
    finally:
        server.terminate()
        server.wait(10)


def _take_pictures(folder: Path, display: str, seconds: float, over: Callable[[], object]) -> None:
    """Take a picture of the screen whenever Blender asks for one, until it is over, or for some
    seconds."""
    end = time.monotonic() + seconds
    while not over() and time.monotonic() < end:
        for request in folder.glob("*.request"):
            # Packed little: a tall screen would take a second.
            ImageGrab.grab(xdisplay=display).save(request.with_suffix(".png"), compress_level=1)
            request.unlink()
        time.sleep(0.02)


def colour_count(path: Path) -> int:
    return len(Image.open(path).convert("RGB").getcolors(1 << 24))
