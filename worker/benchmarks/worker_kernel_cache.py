"""Files of compiled kernels that a power cut, a full disk or an update of numba left behind.

A copy of the user's kernels is damaged, some files at a time; then a command that needs them runs
in a process of its own, and must end as it does with an undamaged cache.
"""

import hashlib
import json
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.table import Asked, Row, Setting
from limber.core.numerics.compiled import KernelCache, cache_folder

KERNELS_ROW = Asked("kernel cache files cut, emptied, of noise or another version (100 asked): "
                    "commands that fail", "0")
_AT_ONCE = 5
Damage = Callable[[Path, np.random.Generator], None]


def _cut(path: Path, rng: np.random.Generator) -> None:
    content = path.read_bytes()
    path.write_bytes(content[:int(rng.integers(len(content)))])


def _noise(path: Path, rng: np.random.Generator) -> None:
    path.write_bytes(rng.bytes(int(rng.integers(1, 4000))))


def _flipped(path: Path, rng: np.random.Generator) -> None:
    content = bytearray(path.read_bytes())
    for at in rng.integers(len(content), size=8):
        content[at] ^= 1 << int(rng.integers(8))
    path.write_bytes(content)


def _of_another_numba(path: Path, _rng: np.random.Generator) -> None:
    """An index as another version writes it, complete and with its checksum; code is removed."""
    if path.suffix != ".nbi":
        path.unlink()
        return
    content = pickle.dumps("0.1.0", protocol=-1) + pickle.dumps((None, {}), protocol=-1)
    path.write_bytes(content + hashlib.sha256(content).digest())


DAMAGES: dict[str, Damage] = {
    "emptied": lambda path, _rng: path.write_bytes(b""), "cut": _cut, "noise": _noise,
    "flipped": _flipped, "another version": _of_another_numba}


def kernels(setting: Setting, template: Path) -> list[Row]:
    """Damage files of the cache, a few for each run of a command."""
    source = cache_folder()
    if source is None:
        return []
    failed, warned, damaged = [], 0, 0
    with tempfile.TemporaryDirectory(prefix="limber-kernels-") as place:
        kept = Path(place, "numba")
        kept.mkdir()
        for name in _own_names():
            for path in source.glob(f"{name}.*"):
                shutil.copy(path, kept)
        folder = Path(shutil.copytree(template, Path(place, "a.branch")))
        wanted, _ = _predicted(folder, kept)
        files = sorted(kept.glob("*.nb[ic]"))
        for number in setting.budget.seeds(0, setting.at_most(100, 10) // _AT_ONCE):
            rng = setting.generator(number)
            setting.progress(damaged / 100, f"{damaged} files")
            for path in rng.choice(np.array(files, object), _AT_ONCE, replace=False):
                if path.exists() and path.stat().st_size:
                    list(DAMAGES.values())[int(rng.integers(len(DAMAGES)))](path, rng)
                    damaged += 1
            found, told = _predicted(folder, kept)
            warned += "compiled again" in told
            if found != wanted:
                failed.append(told[-400:])
    for told in failed[:5]:
        print(told)
    told = f"{len(failed)} ({damaged} files, {warned} runs said so)"
    return [Row(*KERNELS_ROW, told, bool(wanted) and not failed, damaged)]


def _predicted(folder: Path, kept: Path) -> tuple[dict, str]:
    """Result of `limber predict` with these kernels, without its time; and its output."""
    done = subprocess.run(
        [sys.executable, "-m", "limber", "predict", str(folder), "--weight", "0.1", "--json"],
        env=os.environ | {"NUMBA_CACHE_DIR": str(kept)}, check=False, capture_output=True,
        text=True)
    if done.returncode != 0:
        return {}, f"{done.returncode}: {done.stderr}"
    result = json.loads(done.stdout.splitlines()[-1])
    return {name: value for name, value in result.items()
            if name not in ("seconds", "warnings")}, done.stderr


def _own_names() -> set[str]:
    """Names of the files of the kernels that `limber predict` imports, of this Limber."""
    import limber.stages.moduli.predict
    import limber.store.loading  # noqa: F401

    kernels = (value for name, module in list(sys.modules.items()) if name.startswith("limber.")
               for value in vars(module).values())
    caches = (getattr(kernel, "_cache", None) for kernel in kernels)
    return {cache.name for cache in caches if isinstance(cache, KernelCache)}
