"""The separate process of a session that makes its reduced model, checks it and refreshes it.

It holds the full model, so that the session never waits for it. JSON lines, as in
:mod:`limber.session.worker`:

- on standard input first ``{"nodes", "weights", "mode"}``: which patch of the branch is held
  and how; then ``{"pose", "young_pa"}``: compare the reduced model with the full one there. The
  end of input ends it;
- on standard output ``{"progress", "message"}``, ``{"event": "model", "path", "size", "seconds"}``
  whenever a model is ready, and ``{"event": "check", "position_error", "energy_error", "certain",
   "good", "learned"}``.

A model is kept in the cache of :mod:`limber.reduced.model_cache`.
"""

import argparse
import json
import os
import queue
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import Cancelled, LimberError
from limber.core.json_values import plain
from limber.core.progress import JsonSink, Progress
from limber.mechanics.grasp import Grasp
from limber.reduced.model_cache import (
    LearntModel,
    ReducedCache,
    as_control_points,
    default_folder,
    learnt_model,
    model_key,
)
from limber.reduced.refresh import RefreshingModel
from limber.session.protocol import SessionSettings
from limber.session.session_branch import load_held, reduced_settings


def say(**line: Any) -> None:
    """Print one JSON line."""
    print(json.dumps(plain(line)), flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Run the trainer until its input ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("settings", help="the session's settings as JSON")
    options = parser.parse_args(arguments)
    if hasattr(os, "nice"):
        os.nice(5)  # the session answers first
    try:
        with tempfile.TemporaryDirectory(prefix="limber-reduced-") as own:
            settings = SessionSettings.model_validate_json(options.settings)
            folder = settings.cache_folder or default_folder()
            cache = ReducedCache(folder if settings.cache else Path(own),
                                 progress=Progress(on_warning=_warn))
            _serve(options.folder, settings, cache)
    except Cancelled as error:
        return error.exit_code
    except LimberError as error:
        say(event="failed", message=str(error))
        return error.exit_code
    return 0


def _warn(message: str) -> None:
    say(event="warning", message=message)


def _serve(folder: Path, settings: SessionSettings, cache: ReducedCache) -> None:
    progress = Progress(JsonSink(interval_seconds=0.5))
    requests: queue.Queue[dict[str, Any] | None] = queue.Queue()
    threading.Thread(target=_listen, args=(requests, progress), daemon=True).start()
    latest = requests.get()
    if latest is None:
        return
    held = load_held(folder, settings)
    nodes, shares = np.array(latest["nodes"]), np.array(latest["weights"])
    grasp = Grasp(nodes, shares, shares @ held.model.mesh.nodes[nodes], latest["mode"])
    weights, young = as_control_points(held.model)
    about, began = reduced_settings(settings), time.perf_counter()
    key = model_key(held.model, grasp, weights, young, about)
    learnt = learnt_model(held.model, grasp, weights, young, about, cache=cache,
                          progress=progress)
    refreshing = RefreshingModel(held.model, grasp, weights, about, learnt.reduced,
                                 learnt.snapshots)
    _announce(cache, key, refreshing, began, learnt)
    _step_back()
    while (request := requests.get()) is not None:
        began, count = time.perf_counter(), refreshing.refresh_count
        _check(refreshing, request)
        if refreshing.refresh_count > count:
            cache.store(key, refreshing.reduced, refreshing.snapshots)
            _announce(cache, key, refreshing, began)


def _listen(requests: queue.Queue[dict[str, Any] | None], progress: Progress) -> None:
    """Pass on the session's requests; when the session has ended, end the training as well."""
    for line in sys.stdin:
        requests.put(json.loads(line))
    progress.cancel()
    requests.put(None)


def _step_back() -> None:
    """Run only when a core is idle: the session needs 60 Hz. Before there is a model the session
    waits for it, so the trainer runs at a higher priority."""
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    elif hasattr(os, "nice"):
        os.nice(14)


def _check(refreshing: RefreshingModel, request: dict[str, Any]) -> None:
    pose, young = np.array(request["pose"], float), np.array(request["young_pa"], float)
    state = refreshing.reduced.with_young(young).solve_static(pose)
    estimate = refreshing.check(state)
    good = state.converged and estimate.is_small
    learned = not good and refreshing.learn(pose, young, estimate).converged
    say(event="check", position_error=estimate.position, energy_error=estimate.energy,
        certain=estimate.certain, good=good, learned=learned)


def _announce(cache: ReducedCache, key: str, refreshing: RefreshingModel, began: float,
              learnt: LearntModel | None = None) -> None:
    say(event="model", path=str(cache.path(key)), size=refreshing.reduced.size,
        snapshots=len(refreshing.snapshots), refreshes=refreshing.refresh_count,
        from_cache=bool(learnt and learnt.was_known),
        seconds=round(time.perf_counter() - began, 3))


if __name__ == "__main__":
    sys.exit(main())
