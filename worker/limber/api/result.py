"""What the results of all verbs share: they print, draw and become tables."""

import functools
import html
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.optional import require_extra
from limber.store import Branch as Folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_MOST_PRINTED = 7  # values printed in one line; the notebook's table shows all


@dataclass(frozen=True, repr=False, eq=False)
class Result:
    """Result of a stage.

    Attributes:
        values: The output of its command with ``--json``, in SI units that the names contain.

    >>> limber.open("a.branch").results["reconstruct"].values["watertight"]
    True
    """

    values: Mapping[str, Any]

    @classmethod
    def read(cls, branch: Folder, key: str, values: Mapping[str, Any]) -> "Result":
        """Return the result of an entry ``key`` of a branch's manifest, including its files."""
        return cls(MappingProxyType({**values}))

    @property
    def warnings(self) -> tuple[str, ...]:
        """The warnings of the stage."""
        return tuple(self.values.get("warnings", ()))

    def _shown(self) -> dict[str, str]:
        """The printed values, by label."""
        return {name: f"{value:.4g}" if isinstance(value, float) else str(value)
                for name, value in self.values.items() if isinstance(value, bool | int | float)}

    def __repr__(self) -> str:
        parts = [f"{label} {text}" for label, text in self._shown().items()]
        if len(parts) > _MOST_PRINTED:
            parts[_MOST_PRINTED:] = ["..."]
        return f"{type(self).__name__}({', '.join(parts)})"

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><td>{html.escape(label)}</td><td>{html.escape(text)}</td></tr>"
                       for label, text in self._shown().items())
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"


def frozen(values: Any) -> np.ndarray:
    """A copy that cannot be written to; JSON's null is NaN."""
    made = np.array(values, float)
    made.setflags(write=False)
    return made


def columns_of(values: np.ndarray, *names: str) -> dict[str, np.ndarray]:
    return dict(zip(names, values.T, strict=True))


def pose_columns(poses: np.ndarray) -> dict[str, np.ndarray]:
    return columns_of(poses, "x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")


def yes_or_no(value: bool) -> str:
    return "yes" if value else "no"


def drawn(draw: "Callable[[], Figure]") -> "Figure":
    """Draw a figure that a notebook shows once, regardless of its figure settings."""
    require_extra("report", ("matplotlib",), "A picture")
    import matplotlib.pyplot as plt

    figure = draw()
    # An open figure is shown when the cell ends, and again as the value of the cell.
    plt.close(figure)
    vars(figure)["_repr_png_"] = functools.partial(_png, figure)
    return figure


def _png(figure: "Figure") -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=100, bbox_inches="tight")
    return stream.getvalue()
