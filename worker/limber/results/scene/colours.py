"""Colour scales: units, tick labels and colours."""

from typing import Any

import numpy as np

# Colours as sRGB, evenly spaced; both maps stay monotonic in greyscale.
_COLOUR_MAPS = {
    "viridis": ("#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962",
                "#addc30", "#fde725"),
    "inferno": ("#1b0c41", "#4a0c6b", "#781c6d", "#a52c60", "#cf4446", "#ed6925", "#fb9b06",
                "#f7d13d", "#fcffa4"),
}
_MOST_DECADES = 1e3  # range of a logarithmic scale; lower values have its first colour
_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"))


def colour_scale(values: np.ndarray, title: str, unit: str, colours: str) -> dict[str, Any]:
    """Return a scale that spans ``values``: title, unit, low, high, log, ticks, stops, colours; and
    ``is_one``: all values are mid-scale.

    Args:
        colours: ``viridis`` or ``inferno``.
    """
    low, high = float(values.min()), float(values.max())
    is_one = high - low <= 1e-6 * abs(high)
    if is_one:
        # A single value: put it mid-scale, so that it has a colour and a label.
        low, high = (0.5 * low, 1.5 * low) if low > 0 else (low - 0.5, low + 0.5)
    log = low > 0 and high / low > 10.0
    if log:
        low = max(low, high / _MOST_DECADES)
    middle = float(np.sqrt(low * high)) if log else 0.5 * (low + high)
    ticks = [with_unit(value, unit, value if log else high) for value in (low, middle, high)]
    return {"title": title, "unit": unit, "low": low, "high": high, "log": log, "ticks": ticks,
            "stops": _stops(colours), "colours": colours, "is_one": is_one}


def colours_of(values: np.ndarray, scale: dict[str, Any]) -> np.ndarray:
    """Return linear colours of values by a scale, shape [n, 4]."""
    position = _scale_positions(values, scale)
    stops = np.array(scale["stops"])
    channels = [np.interp(position, stops[:, 0], stops[:, channel]) for channel in (1, 2, 3)]
    return np.column_stack([*channels, np.ones_like(position)])


def css_colours(values: np.ndarray, scale: dict[str, Any]) -> list[str]:
    """Return the colours of values by a scale, as style sheets and SVG write them."""
    linear = colours_of(values, scale)[:, :3]
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in
            np.round(255 * srgb).astype(int).tolist()]


def linear_of(srgb: np.ndarray) -> np.ndarray:
    """Return linear values of sRGB values between 0 and 1, as Blender expects colours."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def palette(name: str) -> np.ndarray:
    """Return the linear colours of levels 0 to 255, shape [256, 4]; see :func:`levels_of`."""
    scale = {"low": 0.0, "high": 255.0, "log": False, "stops": _stops(name)}
    return colours_of(np.arange(256.0), scale)


def levels_of(values: np.ndarray, scale: dict[str, Any]) -> np.ndarray:
    """Return the nearest of 256 evenly spaced colours of a scale for each value, as bytes."""
    return np.round(255 * _scale_positions(values, scale)).astype(np.uint8)


def _scale_positions(values: np.ndarray, scale: dict[str, Any]) -> np.ndarray:
    """Return the positions of values on a scale, 0 to 1."""
    low, high = scale["low"], scale["high"]
    if scale["log"]:
        values, low, high = np.log(np.maximum(values, low)), np.log(low), np.log(high)
    return np.clip((values - low) / (high - low), 0.0, 1.0)


def with_unit(value: float, unit: str, size: float) -> str:
    """Return ``value`` as text, with the prefix for ``size``; a fraction may be in %."""
    if not unit:
        return f"{value:.3g}"
    if unit == "%":
        return f"{100 * value:.3g} %"
    # A value that rounds up to a prefix gets it: 1 MPa, not 1e+03 kPa.
    factor, prefix = next((p for p in _PREFIXES if 1.0005 * abs(size) >= p[0]), (1.0, ""))
    return f"{value / factor:.3g} {prefix}{unit}"


def _stops(name: str) -> list[list[float]]:
    """Return rows ``[position 0..1, red, green, blue]``, linear."""
    colours = [linear_of(np.array([int(text[i:i + 2], 16) / 255 for i in (1, 3, 5)])).tolist()
               for text in _COLOUR_MAPS[name]]
    return [[number / (len(colours) - 1), *colour] for number, colour in enumerate(colours)]
