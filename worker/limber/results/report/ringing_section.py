"""The report's section on the vibration of a branch."""

from pathlib import Path

from pydantic import Field

from limber.core.files.reading import FileContent, read_json_as


class VibrationFile(FileContent):
    """Content of ``vibration.json`` that is shown."""

    young_pa: float = Field(gt=0)
    young_interval_pa: tuple[float, float]
    frequencies_hz: list[float] = Field(min_length=1)
    frequency_deviations_hz: list[float]
    damping_ratios: list[float]
    damping_ratio_intervals: list[tuple[float, float]] = Field(default_factory=list)
    model_frequencies_hz: list[float]
    left_over: float


def vibration_rows(path: Path) -> tuple[list[list[str]], list[list[str]]]:
    """Return the modulus, and the vibrations of the record, as rows with a header.

    Raises:
        InputError: the file cannot be read, or has other content.
    """
    result = read_json_as(path, VibrationFile, "the result of a vibration")
    low, high = result.young_interval_pa
    intervals: list[tuple[float, float] | None] = [*result.damping_ratio_intervals]
    modulus = [["quantity", "value", "95 % interval"],
               ["Young's modulus, mean of the branch [MPa]", f"{result.young_pa / 1e6:.4g}",
                f"{low / 1e6:.4g} to {high / 1e6:.4g}"],
               ["unexplained part of the recording", f"{100 * result.left_over:.0f} %", ""]]
    vibrations = [["frequency [Hz]", "+-", "damping", "95 % interval"]]
    vibrations += [[f"{frequency:.4g}", f"{spread:.2g}", f"{100 * ratio:.2f} %",
                    f"{100 * interval[0]:.2f} to {100 * interval[1]:.2f} %" if interval else ""]
                   for frequency, spread, ratio, interval in zip(
                       result.frequencies_hz, result.frequency_deviations_hz, result.damping_ratios,
                       intervals or [None] * len(result.damping_ratios), strict=False)]
    return modulus, vibrations
