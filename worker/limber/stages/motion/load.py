"""Stage ``load``: wind, gusts, snow, fruit or pruning."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import BeforeValidator, Field, field_validator

from limber.core.constants import STANDARD_GRAVITY
from limber.core.errors import InputError, Option, Text
from limber.core.files.atomic import file_digest
from limber.core.files.reading import read_json
from limber.core.json_values import number_array
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups, possible_force
from limber.core.units import table_of
from limber.stages.result import (
    Interval,
    Numbers,
    Picture,
    Result,
    Table,
    Vector,
    frozen,
    kept,
    shown,
)
from limber.stages.stage import About, BranchStage, KeptStage
from limber.store import Branch

if TYPE_CHECKING:
    from limber.mechanics.loads.load_effects import Gusts
    from limber.mechanics.loads.outdoor import Bent
    from limber.mechanics.model import BranchModel
    from limber.results.report.section import Section

_FASTEST_WIND = 150.0  # m/s; more than tornadoes have
_MOST_MULTIPLE = 50.0  # of the loads, up to which a limit load is sought
_STRAIN_LIMIT = 0.01  # at which the wood is taken to fail
_Place = tuple[float, float, float]
_Fruit = tuple[float, float, float, float]


def _pieces(rows: Any) -> np.ndarray:
    try:
        return frozen(number_array([[row[name] for name in ("from_m", "to_m", "strain")]
                                    for row in rows]))
    except (LookupError, TypeError) as error:
        raise ValueError("a piece of the main path lacks from_m, to_m or strain") from error


_Pieces = Annotated[np.ndarray, BeforeValidator(_pieces)]


class GustEffects(Result):
    """Effects of gusts beyond those of the mean wind."""

    mean_speed: float = shown("mean wind", ".2f m/s")
    mean_tip_displacement: Vector = shown("displacement of the tip in the mean wind", ".1f mm",
                                          of=np.linalg.norm)
    factor: float = shown("peak load of the gusts over the mean load", ".2f")
    dynamic: float = shown("dynamic amplification of the sway (1: quasi-static)", ".2f")
    damping: float = shown("damping of the first mode, including the air", ".1f %")


class Load(Result):
    """Effects of wind, snow, fruit or a cut on the branch.

    >>> found = limber.open("a.branch").load(snow=2.0)
    >>> bool(found.frequencies[0] < found.frequencies_before[0]), found.bears_times is None
    (True, True)
    """

    heading = "Load: {name}"
    pictures = (Picture("figures.strain_along_path", "Largest strain of each piece of the "
                        "main path.", ("along",)),)
    columns: ClassVar = {"along": "from_m to_m strain"}

    sag: float = shown("sag of the tip", ".1f mm")
    sag_interval: Interval | None = kept("its 95 % interval [m]; None if the uncertainty of E is "
                                         "unknown")
    greatest_strain: float = shown("largest principal strain", ".5f")
    greatest_strain_interval: Interval | None = kept("its 95 % interval, a strain")
    strain_over_limit: float = shown("largest strain over the failure strain of the wood", ".0f %")
    frequencies: Numbers = shown(
        "first frequency", ".3f Hz", interval="first_frequency_interval", of=itemgetter(0),
        meaning="lowest natural frequencies under the loads [Hz]")
    first_frequency_interval: Interval | None = kept("95 % interval of the first [Hz]")
    frequencies_before: Numbers = shown("first frequency before", ".3f Hz", of=itemgetter(0),
                                        meaning="those without the loads [Hz]")
    tip_displacement: Vector = shown("displacement of the tip", ".1f mm", of=np.linalg.norm)
    wind_force: Vector = shown("force of the wind on the whole branch", ".3g N",
                               of=np.linalg.norm, unless_zero=True)
    added_mass: float = shown("added mass", ".4g kg", unless_zero=True)
    cut_mass: float = shown("mass cut off", ".4g kg", unless_zero=True)
    bears_times: float | None = shown("factor on these loads that the branch bears", ".2f")
    bears_times_interval: Interval | None = kept("its 95 % interval, a factor")
    held_by: str | None = shown("what limits it")
    gusts: GustEffects | None = kept("the effects of gusts")
    along: _Pieces = kept("pieces of the main path: from and to in metres, largest strain")

    @classmethod
    def content(cls, branch: Branch, key: str, values: Mapping[str, Any],
                ) -> tuple[Path, Mapping[str, Any]]:
        if "along" in values:
            return super().content(branch, key, values)
        path = branch.path(f"loads/{key.partition(':')[2]}.json")
        return path, read_json(path, "the effects of loads")

    def tables(self) -> list[Table]:
        limit = self.strain_over_limit / max(self.greatest_strain, 1e-300)
        return [("Greatest strain along the main path", table_of(
            self.values["along"], ("from [m]", "from_m", ".3f"), ("to [m]", "to_m", ".3f"),
            ("strain", "strain", ".5f"),
            ("of the limit", lambda row: limit * row["strain"], ".0f %")))]

    def illustrate(self, section: Section, branch: Branch, key: str) -> None:
        from limber.results.report.figures import bent_branch
        from limber.store.loading import load_mesh

        super().illustrate(section, branch, key)
        section.text += filter(None, [_failure_line(self.values)])
        frames = f"frames/load-{key.partition(':')[2]}"
        if branch.has(f"{frames}.pc2") and branch.has(f"{frames}.npz"):
            try:
                section.draw(bent_branch(load_mesh(branch), branch.path(f"{frames}.pc2")),
                             "The branch as scanned (grey) and at rest under the loads, from the "
                             "front and from the side.")
            except InputError as error:
                section.text.append(f"The bent branch cannot be drawn: {error}")


def _failure_line(result: Mapping[str, Any]) -> str:
    return "There the wood fails." if result.get("strain_over_limit", 0.0) > 1.0 else ""


class ApplyLoads(KeptStage, BranchStage):
    """Compute sag, strain and frequencies under wind, gusts, snow, fruit or pruning."""

    about = About(
        "load", 45, Load, key="load:{name}", reads=("mesh.vtu", "skeleton.swc"),
        writes=("loads/{name}.json", "frames/load-{name}.pc2", "frames/load-{name}.json"),
        found=("Under the loads the tip sags by {sag_m:m}; greatest strain "
               "{greatest_strain:share}, {strain_over_limit:share} of the limit; first frequency "
               "{frequencies_hz[0]:Hz}.", _failure_line,
               "It bears {bears_times:.3g} times these loads; then held by: {held_by}."),
        then="limber report {branch_folder}", step="material", label="Wind, Snow, Fruit, Cuts")
    groups: ClassVar[Groups] = {
        "loads": ("wind", "snow", "fruit", "cut"),
        "gusts": ("gust", "gust_record"),
        "limits": ("limit_load",),
        "output": ("name",)}
    common = ("wind", "gust", "snow", "fruit", "cut", "name")

    wind: tuple[float, float, float] | None = Field(
        None, description="Wind velocity in the branch's frame [m/s].",
        json_schema_extra={"metavar": "X Y Z"})
    gust: float | None = Field(
        None, gt=0, le=1, description="Turbulence intensity of gusts: standard deviation of the "
        "wind speed over its mean, from 0.1 over water to 0.4 in a crown. Results are then those "
        "of the peak, by spectrum and peak factor of EN 1991-1-4, annex B.")
    gust_record: Path | None = Field(
        None, description="Recorded gusts: a CSV file with time_s and speed_m_s along the "
        "direction of --wind.")
    snow: float = Field(0.0, ge=0, le=1000, description="Snow load per area of the branch seen "
                        "from above [kg/m^2].")
    fruit: tuple[_Fruit, ...] = Field(
        (), description="A fruit: position on the branch [m] and mass [kg]. May be given several "
                        "times.",
        json_schema_extra={"metavar": "X Y Z KG"})
    cut: tuple[_Place, ...] = Field(
        (), description="Position of a pruning cut [m]. May be given several times.",
        json_schema_extra={"metavar": "X Y Z"})
    limit_load: bool = Field(
        False, description="Also find the limit load, as a multiple of these loads.")
    name: str | None = Field(
        None, pattern=r"^[\w-]+$", max_length=60, description="Keep the result in the branch "
        "folder under this name, for report and scene.")

    @field_validator("wind")
    @classmethod
    def _possible_wind(cls, value: _Place | None) -> _Place | None:
        if value is not None and (speed := math.hypot(*value)) > _FASTEST_WIND:
            raise ValueError(f"no wind has {speed:g} m/s; {speed / 3.6:g} m/s would be {speed:g} "
                             "km/h")
        return value

    @field_validator("fruit")
    @classmethod
    def _possible_fruit(cls, values: tuple[_Fruit, ...]) -> tuple[_Fruit, ...]:
        possible_force(tuple(fruit[3] * STANDARD_GRAVITY for fruit in values))
        return values

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Bring the branch to rest under loads.

        With a name it writes ``loads/NAME.json``, and ``frames/load-NAME.pc2``, ``.json`` and
        ``.npz``: the branch as scanned, and at rest under the loads. Without one it writes no file.

        Returns:
            The output of :func:`~limber.mechanics.loads.load_effects.load_effects` (sag, largest
            strain and strain along the main path, frequencies; with ``limit_load`` how many times
            the loads it bears; each with its interval, None if the uncertainty of the moduli is
            unknown), and ``frequencies_before_hz``. With gusts all values are those of their peak,
            and ``gusts`` has the output of :func:`~limber.mechanics.loads.load_effects.with_peak`.

        Raises:
            InputError: there is no load, one off the branch, or gusts without wind.
            WorkError: there is no equilibrium under it.
        """
        from limber.mechanics.added_masses import PointMass
        from limber.mechanics.dynamics.motion import lowest_modes
        from limber.mechanics.loads.load_effects import blown, load_effects, with_peak
        from limber.mechanics.loads.outdoor import LoadedOutdoors, Outdoors
        from limber.store.loading import (
            known_damping,
            load_branch,
            load_skeleton,
            stiffness_deviation,
        )

        gusts = _gusts(self)
        wind = blown(self.wind or (0.0, 0.0, 0.0), gusts)
        if not (self.wind or self.snow or self.fruit or self.cut):
            raise InputError("No load is given.",
                             "The scanned shape already carries the branch's own weight.",
                             "Give ", Option("wind"), ", ", Option("snow"), ", ",
                             Option("fruit"), " or ", Option("cut"), ".")
        if any(not one[3] > 0 for one in self.fruit):
            raise InputError("A fruit without mass.", "", "Give ", Option("fruit"), " X Y Z KG.")
        # Without a name nothing is stored.
        branch = (Branch.read if self.name is None else Branch.open)(self.branch_folder)
        inputs = _inputs(branch, self)
        if self.name is not None and self.is_kept(branch, **inputs):
            return read_json(branch.path(f"loads/{self.name}.json"), "the effects of loads")
        skeleton = load_skeleton(branch)
        model = load_branch(branch, loaded=True, progress=progress).model
        _require_near(model.mesh.nodes, [one[:3] for one in self.fruit])
        loads = Outdoors(wind, snow=self.snow, cuts=self.cut, fruit=tuple(
            PointMass(one[:3], one[3]) for one in self.fruit))
        outdoors = LoadedOutdoors(model, skeleton, loads)
        peak = None
        if gusts is not None:
            progress(0.1, "gusts")
            outdoors, peak = with_peak(outdoors, gusts, known_damping(branch, progress))
        bent, result = load_effects(
            outdoors, strain_limit=_STRAIN_LIMIT, deviation=stiffness_deviation(branch),
            most=_MOST_MULTIPLE if self.limit_load else None, progress=progress.part(0.2, 1.0))
        result |= {"frequencies_before_hz": lowest_modes(model, len(bent.frequencies)).frequencies,
                   "gusts": peak}
        if self.name is not None:
            _keep(branch, self, inputs, model, bent, result)
        return result


def _inputs(branch: Branch, settings: ApplyLoads) -> dict[str, Any]:
    """Further inputs of the result beside the settings, in the form for the store."""
    reads = [file for file in ("mesh.vtu", "skeleton.swc", "skeleton.csv", "point_masses.json",
                               "targets.json", "estimate.json") if branch.has(file)]
    # Damping and the interval may come from a swing's result alone.
    digests = {key:
               hashlib.sha256(branch.manifest.stages[key].model_dump_json().encode()).hexdigest()
               for key in ("estimate", "swing", "vibration") if key in branch.manifest.stages}
    record = settings.gust_record
    return {"reads": reads, "digests": digests | (
        {} if record is None else {"gust_record": file_digest(record)})}


def _keep(branch: Branch, settings: ApplyLoads, inputs: dict[str, Any], model: BranchModel,
          bent: Bent, result: dict[str, Any]) -> None:
    """Write the result, and the branch before and under the loads as frames."""
    from limber.core.json_values import plain
    from limber.mechanics.strain import strain_state
    from limber.results.motion_files import surface_fields, surface_nodes, write_pc2

    nodes, name = surface_nodes(model.mesh), f"frames/load-{settings.name}"
    displacements = np.stack([np.zeros_like(bent.displacement), bent.displacement])
    states = [strain_state(model, displacement) for displacement in displacements]
    with branch.stage(f"load:{settings.name}", settings, **inputs) as stage:
        stage.write(f"loads/{settings.name}.json", result)
        write_pc2(stage.path(f"{name}.pc2"), model.mesh.nodes[nodes] + displacements[:, nodes])
        np.savez_compressed(stage.path(f"{name}.npz"), **surface_fields(model.mesh, states))
        stage.write(f"{name}.json", {
            "frame_count": len(displacements), "rate": 1.0,
            "largest_principal_strains": [float(state.principal_strain[:, -1].max())
                                          for state in states]})
        stage.result.update({key: value for key, value in plain(result).items() if key != "along"})


def _gusts(settings: ApplyLoads) -> Gusts | None:
    """The requested gusts."""
    from limber.mechanics.loads.load_effects import Turbulence, WindRecord

    if settings.gust is not None and settings.gust_record is not None:
        raise InputError(
            Text("Both ", Option("gust"), " and ", Option("gust_record"), " were given."), "The "
            "record already contains the gusts.", "Omit one of them.")
    if settings.gust_record is not None:
        return WindRecord.read(settings.gust_record)
    return None if settings.gust is None else Turbulence(settings.gust)


def _require_near(nodes: np.ndarray, points: list[_Place]) -> None:
    for point in points:
        distance = float(np.linalg.norm(nodes - np.array(point), axis=1).min())
        if not distance < 0.1:
            raise InputError(f"A fruit at {point} m is {distance:.3g} m away from the branch.",
                             "A fruit must hang on the branch.", "Check frame and unit.").at(point)
