"""Runs the parts of the suite one after another; ends with one table and one exit code.

scripts/test calls it after the set-up. A part that fails hides no other part.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

ROOT = Path(__file__).parents[1]
BIN = Path(sys.prefix) / ("Scripts" if os.name == "nt" else "bin")
PYTEST = [sys.executable, "-m", "pytest"]
NO_TESTS = 5
"""pytest's exit code where no test was selected."""
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
# As many tests at once as there are cores to run them: tests of the robot wait 5 s for a process.
SIDE_BY_SIDE = ["-n", str(min(CORES, 2)), "--dist", "worksteal"]
# The robots' loops have real-time priority, so these follow their clocks of 2 and 8 ms beside
# others, which are nice. What fails all the same is tried once more, alone.
REAL_TIME = ["tests/robot", "-m", "real_time and not campaign", "--durations", "5",
             "-o", "cache_dir=.pytest_cache/real_time"]
# They mostly wait: for a window, for a click's effect.
REAL_BLENDER = ["tests/addon", "-m", "real_blender and not campaign", "--durations", "5",
                "-o", "cache_dir=.pytest_cache/real_blender"]
CHECKS = {"types": [BIN / "mypy"], "layers": [BIN / "lint-imports", "--no-cache", "--no-logo"],
          "packages": [sys.executable, ROOT / "scripts/check_dependencies"]}
DURATIONS = ROOT / "tests" / "durations.json"
"""Seconds of each test over half a second, longest first, as the last whole run measured them."""
LONG_SECONDS = 5.0
"""A test that takes longer is marked `slow` or `campaign`, or was there before this rule."""


@dataclass
class Part:
    """What one part of the suite came to."""

    name: str
    seconds: float
    failed: bool
    counts: Counter[str] | None = None
    skips: Counter[str] = field(default_factory=Counter)
    seconds_of: dict[str, float] = field(default_factory=dict)
    unmarked: set[str] = field(default_factory=set)


def main(arguments: list[str]) -> int:
    """Run the parts that ``arguments`` ask for; 0 if all passed, else 1."""
    parser = argparse.ArgumentParser(prog="scripts/test", description=__doc__, epilog=(
        "Other arguments go to pytest: scripts/test tests/geometry -k skeleton"))
    parser.add_argument("--fast", action="store_true",
                        help="style, types, layers and quick tests of every package: for each save")
    parser.add_argument("--campaign", action="store_true",
                        help="the long tests that no other run has: for each night")
    parser.add_argument("--ci", action="store_true",
                        help="also bring a real Blender first and test zip and wheel last")
    asked, others = parser.parse_known_args(arguments)
    parts = [Part("set-up", float(os.environ.get("LIMBER_SETUP_SECONDS", "0")), False)]
    if asked.ci:
        parts.append(provided_blender())
    parts.append(command("style", [BIN / "ruff", "check", "addon", "worker", "tests", "scripts"]))
    parts.extend(tests(asked.fast, asked.campaign, others))
    parts.extend(unmarked_parts(parts))
    if not (asked.fast or asked.campaign or others):
        write_durations(parts)
    if asked.ci:
        parts += [command("zip", [ROOT / "scripts" / "test_zip", "--oldest"]),
                  command("wheel", [ROOT / "scripts" / "test_wheel"])]
    print(summary(parts), flush=True)
    return int(any(part.failed for part in parts))


def command(name: str, words: list, output: Path | None = None) -> Part:
    """Run a program as one part; with a file for its output it runs beside others."""
    began = time.monotonic()
    failed = _run(name, words, output) != 0
    return Part(name, time.monotonic() - began, failed)


def tests(fast: bool, campaign: bool, others: list[str]) -> list[Part]:
    """The tests, and what runs beside them: those chosen by pytest's own arguments, the quick
    ones, the campaigns, or all.
    """
    if campaign:
        return [pytest_part("campaign", ["-m", "campaign", "--timeout", "3600", *others])]
    if others and not fast:
        return [pytest_part("tests", ["-m", "not campaign", *others])]
    asides = [partial(command, name, words) for name, words in CHECKS.items()]
    apart = "not real_time and not real_blender and not campaign"
    if fast:
        chosen = ["-m", f"not slow and {apart}", *others]
    else:
        asides += [partial(pytest_part, "real time", REAL_TIME),
                   partial(pytest_part, "Blender", REAL_BLENDER)]
        chosen = ["-m", apart, "--durations", "20"]
    parts = beside(partial(pytest_part, "tests", [*SIDE_BY_SIDE, *chosen]), asides)
    return [tried_again(part, REAL_TIME) if part.failed and part.name == "real time" else part
            for part in parts]


def beside(main: Callable[[], Part], asides: list[Callable[..., Part]]) -> list[Part]:
    """Run a part, and others one after another beside it; what they print follows."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(1) as second:
        outputs = [Path(folder) / f"{number}.txt" for number in range(len(asides))]
        running = [second.submit(aside, output=output)
                   for aside, output in zip(asides, outputs, strict=True)]
        parts = [main()]
        for each, output in zip(running, outputs, strict=True):
            parts.append(each.result())
            print(f"\n=== {parts[-1].name} ===\n{output.read_text(encoding='utf-8')}", flush=True)
    return parts


def unmarked_parts(parts: list[Part]) -> list[Part]:
    """A failed part if new tests take long without a mark that says so."""
    if not DURATIONS.exists():
        return []
    known = json.loads(DURATIONS.read_text(encoding="utf-8"))
    long = [f"{name} ({part.seconds_of[name]:.0f} s)" for part in parts for name in
            sorted(part.unmarked - set(known)) if part.seconds_of[name] > LONG_SECONDS]
    for name in long:
        print(f"scripts/test: takes over {LONG_SECONDS:.0f} s without the mark slow or campaign: "
              f"{name}", flush=True)
    return [Part("durations", 0.0, True)] if long else []


def write_durations(parts: list[Part]) -> None:
    """Keep how long the tests of a whole run took, to half a second."""
    rounded = {name: round(2 * seconds) / 2 for part in parts
               for name, seconds in part.seconds_of.items() if seconds > 0.5}
    ordered = dict(sorted(rounded.items(), key=lambda one: (-one[1], one[0])))
    DURATIONS.write_text(json.dumps(ordered, indent=0) + "\n", encoding="utf-8")


def tried_again(part: Part, arguments: list[str]) -> Part:
    """Run what failed in a part once more."""
    print("scripts/test: once more, what failed of the part above", flush=True)
    again = pytest_part(part.name, [*arguments, "--last-failed", "--last-failed-no-failures",
                                    "none"])
    counts = None
    if part.counts and again.counts:
        counts = Counter(part.counts)
        counts["passed"] += counts["failed"] - again.counts["failed"]
        counts["failed"] = again.counts["failed"]
    return Part(part.name, part.seconds + again.seconds, again.failed, counts, part.skips)


def pytest_part(name: str, arguments: list[str], output: Path | None = None) -> Part:
    """Run pytest as one part; with a file for its output it runs beside others."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        code = _run(name, [*PYTEST, *arguments, "--junit-xml", report,
                           "-o", "junit_duration_report=call"], output)
        counts, skips = _counted(report)
        seconds_of, unmarked = _timed(report)
    return Part(name, time.monotonic() - began, code not in (0, NO_TESTS), counts, skips,
                seconds_of, unmarked)


def _run(name: str, words: list, output: Path | None) -> int:
    """Run a program; all but the robots' tests let others go first. Returns its exit code."""
    if output is None:
        print(f"\n=== {name} ===", flush=True)
    polite = ["nice"] if name != "real time" and shutil.which("nice") else []
    with output.open("w") if output else nullcontext() as file:
        return subprocess.run([*polite, *map(str, words)], cwd=ROOT, stdout=file, stderr=file,
                              check=False).returncode


def _counted(report: Path) -> tuple[Counter[str], Counter[str]]:
    """Count passed, failed and skipped tests of a JUnit report, and the reasons of the skips."""
    counts: Counter[str] = Counter()
    skips: Counter[str] = Counter()
    if not report.exists():
        return counts, skips
    for case in ElementTree.parse(report).iter("testcase"):
        skip = case.find("skipped")
        if skip is not None:
            counts["skipped"] += 1
            skips[skip.get("message") or "no reason given"] += 1
        elif case.find("failure") is not None or case.find("error") is not None:
            counts["failed"] += 1
        else:
            counts["passed"] += 1
    return counts, skips


def _timed(report: Path) -> tuple[dict[str, float], set[str]]:
    """Return the seconds of each test of a JUnit report, and which have no mark of a long one."""
    seconds, unmarked = {}, set()
    for case in ElementTree.parse(report).iter("testcase") if report.exists() else ():
        name = f"{case.get('classname')}::{case.get('name')}"
        seconds[name] = float(case.get("time") or 0.0)
        if all(one.get("name") != "long" for one in case.iter("property")):
            unmarked.add(name)
    return seconds, unmarked


def provided_blender() -> Part:
    """Bring a real Blender (as root, where LIMBER_BLENDER names none); tests find it by that."""
    began = time.monotonic()
    if "LIMBER_BLENDER" in os.environ or not hasattr(os, "getuid") or os.getuid() != 0:
        return Part("Blender", 0.0, False)
    print("\n=== Blender ===", flush=True)
    done = subprocess.run([ROOT / "scripts" / "provision_blender", "--gui-test"], cwd=ROOT,
                          stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode == 0:
        os.environ["LIMBER_BLENDER"] = done.stdout.strip().splitlines()[-1]
    else:
        print("no real Blender could be provided: its tests will be skipped", flush=True)
    return Part("Blender", time.monotonic() - began, False)


def summary(parts: list[Part]) -> str:
    """The table of all parts, why tests were skipped, and a closing line."""
    lines = ["", f"{'part':<10} {'seconds':>8} {'passed':>7} {'failed':>7} {'skipped':>8}"]
    for part in parts:
        numbers = ([str(part.counts[key]) for key in ("passed", "failed", "skipped")]
                   if part.counts else ["-", "failed" if part.failed else "-", "-"])
        lines.append(f"{part.name:<10} {part.seconds:>8.0f} {numbers[0]:>7} {numbers[1]:>7} "
                     f"{numbers[2]:>8}")
    skips = sum((part.skips for part in parts), Counter())
    if skips:
        lines += ["", "Skipped:"]
        lines += [f"{count:>4}  {re.sub(r'^Skipped: ', '', reason)}"
                  for reason, count in sorted(skips.items())]
    total = sum((part.counts for part in parts if part.counts), Counter())
    broken = sum(part.failed and not (part.counts and part.counts["failed"]) for part in parts)
    lines += ["", f"{total['passed']} passed, {total['failed'] + broken} failed, "
                  f"{total['skipped']} skipped"]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
