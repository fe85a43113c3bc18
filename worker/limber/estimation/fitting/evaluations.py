"""Log of all forward simulations of an estimate, from which a stopped estimate resumes."""

import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from limber.core.json_lines import json_object


@dataclass(frozen=True)
class EvaluationEntry:
    """One evaluation: free vector, objective, the paper's loss [m^2] and time [s].

    Objective and loss are None if the simulation found no equilibrium.
    """

    parameters: tuple[float, ...]
    objective: float | None
    loss: float | None
    seconds: float


class EvaluationLog:
    """Appends one JSON line per evaluation, and reads those of an earlier run.

    The first line has a digest of the problem; evaluations of another problem are not reused.
    """

    def __init__(self, path: Path | None, problem: str):
        self.entries: list[EvaluationEntry] = []
        self.resumed_count = 0
        self._known: dict[bytes, EvaluationEntry] = {}
        self._path = path
        self._started = time.perf_counter()
        self._problem = problem
        if path is not None:
            self._resume(path)

    @property
    def best(self) -> EvaluationEntry | None:
        """The entry of the smallest objective; None: no evaluation had an equilibrium."""
        found = [(entry.objective, number, entry) for number, entry in enumerate(
            [*self.entries, *self._known.values()]) if entry.objective is not None]
        return min(found)[2] if found else None

    def find(self, parameters: np.ndarray) -> EvaluationEntry | None:
        """Return the entry of an earlier run with exactly these parameters."""
        return self._known.get(_key(parameters))

    def add(self, parameters: np.ndarray, objective: float | None, loss: float | None) -> None:
        """Add an evaluation. Its line is on disk when this returns."""
        entry = EvaluationEntry(tuple(float(x) for x in parameters), objective, loss,
                                round(time.perf_counter() - self._started, 4))
        self.entries.append(entry)
        if self._path is not None:
            with open(self._path, "a", encoding="utf-8") as stream:
                stream.write(json.dumps(entry.__dict__) + "\n")

    def forget(self) -> None:
        """Remove the file after the estimate."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def _resume(self, path: Path) -> None:
        lines = (path.read_text(encoding="utf-8", errors="replace").splitlines()
                 if path.exists() else [])
        header = json_object(lines[0]) if lines else None
        if header is None or header.get("problem") != self._problem:
            path.write_text(json.dumps({"problem": self._problem}) + "\n", encoding="utf-8")
            return
        for line in lines[1:]:
            record = json_object(line) or {}
            try:
                entry = EvaluationEntry(**(record | {"parameters": tuple(record["parameters"])}))
                self._known[_key(np.array(entry.parameters))] = entry
            except (KeyError, TypeError, ValueError):
                continue  # a damaged line: repeat that evaluation
        self.resumed_count = len(self._known)


def _key(parameters: np.ndarray) -> bytes:
    return np.asarray(parameters, float).tobytes()
