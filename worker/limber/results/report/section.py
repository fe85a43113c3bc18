"""Sections of the report: text, tables and embedded pictures."""

import base64
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from limber.core.errors import Command, InputError, Option


@dataclass
class Section:
    """One section of the page; ``missing`` is the command that would fill it."""

    title: str
    text: list[str] = field(default_factory=list)
    pictures: list[tuple[str, str]] = field(default_factory=list)
    tables: list[tuple[str, list[list[str]]]] = field(default_factory=list)
    missing: str = ""

    def draw(self, figure: Any, caption: str) -> None:
        """Add a matplotlib figure as an embedded PNG."""
        self.pictures.append((inline_png(_png(figure)), caption))


def read_png(path: Path) -> bytes:
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).", "It should be shown at the "
                         "top of the report.", "Omit ", Option("picture"), ", or name the PNG "
                         "that ", Command("scene"), " rendered.") from error
    if not data.startswith(b"\x89PNG"):
        raise InputError(f"{path} is not a PNG file.", "The report shows only PNG.", "Name a PNG.")
    return data


def _png(figure: Any) -> bytes:
    import matplotlib.pyplot as plt

    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=130, bbox_inches="tight")
    plt.close(figure)
    return stream.getvalue()


def inline_png(data: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(data).decode("ascii")
