"""A Blender with a window on a screen of its own: driven by a script, its pictures taken."""

import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
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
    """Run a script that drives Blender in a window as large as the screen; return what it has seen.
    """
    with virtual_screen(size) as display:
        process = subprocess.Popen(
            [blender, "--enable-event-simulate", "--window-geometry", "0", "0", *map(str, size),
             "--python", str(FOLDER / script), "--", str(folder)],
            env=environment | {"DISPLAY": display}, stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE, text=True)
        try:
            _take_pictures(folder, display, process, seconds)
        finally:
            process.kill()
    assert (folder / "log.json").is_file(), process.stderr.read()[-2000:]
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


def _take_pictures(folder: Path, display: str, process: subprocess.Popen,
                   seconds: float) -> None:
    """Take a picture of the screen whenever Blender asks for one; return when it has ended, or
    after some seconds."""
    end = time.monotonic() + seconds
    while process.poll() is None and time.monotonic() < end:
        for request in folder.glob("*.request"):
            # Packed little: a tall screen would take a second.
            ImageGrab.grab(xdisplay=display).save(request.with_suffix(".png"), compress_level=1)
            request.unlink()
        time.sleep(0.02)


def colour_count(path: Path) -> int:
    return len(Image.open(path).convert("RGB").getcolors(1 << 24))
