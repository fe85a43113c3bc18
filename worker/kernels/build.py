"""Builds the kernels' libraries: for this machine by its C++ compiler, for others by ziglang.

    python worker/kernels/build.py                     for this machine, into worker/limber/kernels
    python worker/kernels/build.py FOLDER TARGET ...   for these systems; `all` for all of them

One library a system serves every Python. x86-64 has two, one for processors with AVX2. Nothing
is built where the library was made from these sources.
"""

import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HERE = Path(__file__).resolve().parent
TARGETS = {
    "linux-x64": "x86_64-linux-gnu.2.28", "linux-arm64": "aarch64-linux-gnu.2.28",
    "windows-x64": "x86_64-windows-gnu", "macos-arm64": "aarch64-macos.11.0",
    "macos-x64": "x86_64-macos.11.0"}
"""Systems that releases serve, by ziglang's names with the oldest C library or system."""
ENDINGS = {"linux": ".so", "windows": ".dll", "macos": ".dylib"}
# No contraction, no reordering: every compiler and processor gives the same digits.
FLAGS = ("-std=c++20", "-ffp-contract=off", "-fno-math-errno", "-fno-exceptions", "-fno-rtti",
         "-fvisibility=hidden", "-Wall", "-Wextra", "-Wno-psabi")


def host() -> str:
    """Return this machine's name among the targets."""
    system = {"Linux": "linux", "Darwin": "macos", "Windows": "windows"}.get(
        platform.system(), platform.system())
    machine = platform.machine().lower()
    known = {"x86_64": "x64", "amd64": "x64", "aarch64": "arm64"}
    return f"{system}-{known.get(machine, machine)}"


def compiler() -> list[str]:
    """Return this machine's C++ compiler; nothing if it has none."""
    if os.environ.get("CXX"):
        return os.environ["CXX"].split()
    found = next(filter(None, map(shutil.which, ("g++", "clang++", "c++"))), None)
    return [found] if found else []


def build(folder: Path, *targets: str) -> None:
    """Build the libraries of some targets (default: this machine's) where sources have changed."""
    folder.mkdir(parents=True, exist_ok=True)
    sources = sorted(HERE.rglob("*.cpp"))
    digest = hashlib.sha256()
    for path in [*sources, *sorted(HERE.rglob("*.hpp")), Path(__file__)]:
        digest.update(path.name.encode() + path.read_bytes())
    mark = f"{digest.hexdigest()} {'ziglang' if targets else 'own'}"
    for target in targets or (host(),):
        stamp = folder / f"{target}.digest"
        if not stamp.is_file() or stamp.read_text(encoding="utf-8") != mark:
            _build_one(folder, target, sources, is_cross=bool(targets))
            stamp.write_text(mark, encoding="utf-8")


def _build_one(folder: Path, target: str, sources: list[Path], is_cross: bool) -> None:
    system, _, machine = target.partition("-")
    command = [] if is_cross else compiler()
    if not command:
        if importlib.util.find_spec("ziglang") is None:
            raise RuntimeError(f"The kernels for {target} want a C++ compiler: ziglang (pip "
                               "install ziglang), or for this machine alone g++ or clang++.")
        command = [sys.executable, "-m", "ziglang", "cc"]
        if target in TARGETS:
            command += ["-target", TARGETS[target]]
    levels = {"": "v2", "-v3": "v3"} if machine == "x64" else {"": ""}
    with tempfile.TemporaryDirectory(dir=folder) as place:
        def compiled(level: str, source: Path) -> str:
            made = str(Path(place, f"{source.stem}{level}.o"))
            _run([*command, *FLAGS, *_processor(command, levels[level]),
                  *([] if system == "windows" else ["-fPIC"]), "-c", str(source), "-o", made])
            return made

        def linked(level: str) -> None:
            name = f"{target}{level}{ENDINGS.get(system, '.so')}"
            parts = pool.map(lambda source: compiled(level, source), sources)
            libraries = ["-Wl,--as-needed", "-lm"] if system == "linux" else []
            _run([*command, *_processor(command, levels[level]), "-shared", "-s", *parts,
                  "-o", str(Path(place, name)), *libraries])
            # Processes that have the old one open keep it.
            os.replace(Path(place, name), folder / name)

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for level in levels:
                linked(level)


def _processor(command: list[str], level: str) -> list[str]:
    # The one for old processors is built in half the time; its digits are the same.
    effort = "-O2" if level == "v2" else "-O3"
    if not level:
        return [effort]
    return [effort, f"-mcpu=x86_64_{level}" if "ziglang" in command else f"-march=x86-64-{level}"]


def _run(command: list[str]) -> None:
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}\n{done.stderr}")


if __name__ == "__main__":
    wanted = TARGETS if sys.argv[2:] == ["all"] else sys.argv[2:]
    build(Path(sys.argv[1]) if sys.argv[1:] else HERE.parent / "limber" / "kernels", *wanted)
