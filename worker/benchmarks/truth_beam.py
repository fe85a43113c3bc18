"""Estimates of a hung beam: over meshes, from the real recording, and drops under other loads."""

import tempfile
from pathlib import Path

import numpy as np

from benchmarks import silicone_beam
from benchmarks.table import Row
from limber.estimation.settings import EstimateSettings, PredictSettings
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.marks import mark
from limber.progress import Progress
from limber.recordings.settings import ImportSettings
from limber.stages.estimate import estimate
from limber.stages.import_pull import import_pull
from limber.stages.predict import predict
from limber.store import Branch

MESHES = ((6, 2, 2), (9, 3, 3), (12, 4, 4))
"""Bricks along and across the beam, each cut in six quadratic tetrahedra."""
OTHERS_PA = ((264e3, 264e3), (264e3, 295e3), (283e3, 283e3))
"""Of the real beam, by three other programs; one of them gives a range."""
OTHER_LOADS_N = (0.2, 1.0)


def rows(progress: Progress, seed: int) -> list[Row]:
    """Measure everything; ``seed`` draws the simulated recordings."""
    rng = np.random.default_rng([seed, 41])
    young = float(np.exp(rng.uniform(np.log(1.8e5), np.log(4e5))))
    drawn = int(rng.integers(2**31))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        silicone_beam.simulated_recording(folder / "hung.csv", young,
                                          silicone_beam.LOAD_N, drawn)
        found = []
        for number, cells in enumerate(MESHES):
            progress(number / 4, "one recording over three meshes")
            found.append(_estimated(folder, cells))
        table = [_refinement_row(found), _drop_row(folder, young, drawn)]
        progress(0.8, "the real beam")
        return [*table, _real_row(folder)]


def _estimated(folder: Path, cells: tuple[int, int, int]) -> dict:
    """The estimate from the simulated recording on bricks of ``cells``.

    Poisson's ratio is given: near one half it would take up a coarse mesh's stiffness.
    """
    beam = silicone_beam
    length, width, height = beam.SIZE_M
    axis = np.column_stack([np.linspace(-length, 0.0, 21), np.full(21, width / 2),
                            np.full(21, height / 2)])
    skeleton = Skeleton.from_edges(axis, np.arange(-1, 20), np.full(21, width / 2))
    branch = Branch.create(_branch(folder, cells))
    with branch.stage("mesh") as stage:
        mark(beam.box_mesh(cells), skeleton, young=2e5, poisson=beam.POISSON,
             density=beam.DENSITY).write(stage.path("mesh.vtu"))
        skeleton.write_swc(stage.path("skeleton.swc"))
    rows = [f"{label},{x:.6f},{y:.6f},{z:.6f}"
            for label, (x, y, z) in zip(beam.LABELS, beam.NOMINAL_M, strict=True)]
    (folder / "places.csv").write_text("\n".join(["label,x_m,y_m,z_m", *rows]) + "\n",
                                       encoding="utf-8")
    import_pull(branch.folder, folder / "hung.csv", "hung", ImportSettings(
        nominal=str(folder / "places.csv"), weight=beam.LOAD_N, own_weight=True,
        grasp_point=tuple(beam.LOAD_POINT_M.tolist()), grasp_radius=0.012))
    return estimate(branch.folder, EstimateSettings(
        fractions=(0.5,), density_sigma=0.02, poisson_sigma=0.0))


def _branch(folder: Path, cells: tuple[int, int, int]) -> Path:
    return folder / f"beam-{cells[0]}.branch"


def _refinement_row(found: list[dict]) -> Row:
    young = np.array([each["young_pa"][0] for each in found])
    spread = float(np.ptp(young) / young.mean())
    each = ", ".join(f"{value / 1e3:.1f}" for value in young)
    return Row("mesh refinement of clamp and grasp: E of one recording over three meshes",
               "0.7 %", f"{100 * spread:.2f} % ({each} kPa on "
               f"{', '.join(str(6 * int(np.prod(cells))) for cells in MESHES)} tetrahedra)",
               bool(spread <= 0.007))


def _drop_row(folder: Path, young: float, drawn: int) -> Row:
    """Other loads on the middle mesh, against the drop of a mesh of another kind."""
    worst, held, told = 0.0, 0, []
    branch = _branch(folder, MESHES[1])
    for load in OTHER_LOADS_N:
        truth = silicone_beam.simulated_recording(folder / "other.csv", young, load, drawn)
        found = predict(branch, PredictSettings(pull="hung", weight=load))
        drop = float(np.mean(np.array(found["drops_m"])[silicone_beam.TIPS]))
        low, high = found["drop_interval_m"]
        # The interval is that of the points that move most: the tips.
        held += low <= truth <= high
        worst = max(worst, abs(drop / truth - 1))
        told.append(f"{load:g} N {1e3 * drop:.2f} of {1e3 * truth:.2f} mm "
                    f"({1e3 * low:.2f} to {1e3 * high:.2f})")
    return Row("drops under other loads, simulated recordings", "3 % and inside their interval",
               f"{100 * worst:.1f} %, {held} of {len(OTHER_LOADS_N)} inside: {'; '.join(told)}",
               bool(worst <= 0.03 and held == len(OTHER_LOADS_N)))


def _real_row(folder: Path) -> Row:
    measure = "silicone beam: static E of the given recording (dynamic: not measured here)"
    asked = "its interval holds what other programs found: 264, 264 to 295, 283 kPa"
    if not silicone_beam.RECORDING.is_file():
        return Row(measure, asked, "the recording is not here", None)
    found = silicone_beam.estimate_beam(silicone_beam.made_branch(folder), silicone_beam.RECORDING,
                                        silicone_beam.LOAD_N, "csv")
    low, high = found.interval
    outside = [each for each in OTHERS_PA if each[1] < low or each[0] > high]
    return Row(measure, asked,
               f"{found.young / 1e3:.0f} kPa ({low / 1e3:.0f} to {high / 1e3:.0f}); outside: "
               + (", ".join(f"{each[0] / 1e3:.0f}" for each in outside) or "none")
               + f"; drop {1e3 * found.simulated_drop:.2f} of {1e3 * found.measured_drop:.2f} mm",
               not outside)
