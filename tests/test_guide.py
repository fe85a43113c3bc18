"""The guide builds without a warning, and explains every option and public name."""

import datetime
import importlib
import json
import math
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import click
import pytest

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "worker" / "docs"
_UNITS = ("mm|cm|m|s|ms|N|kg|g|GPa|MPa|kPa|Pa|Hz|MB|GB|degrees|minutes|seconds|hours|trials|rad|J"
          "|mJ|points|tetrahedra")


@pytest.mark.slow
def test_the_guide_builds_without_a_warning(tmp_path):
    """Warnings are errors: dead references, pages in no table of contents, bad tables.

    `scripts/docs` builds it with its tutorials and pictures executed.
    """
    pytest.importorskip("sphinx_gallery", reason="the extra docs is not installed")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "-d",
         tmp_path / "doctrees", "-D", "run_commands=0", "-D", "plot_gallery=0",
         GUIDE, tmp_path / "html"],
        capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    commands = (tmp_path / "html" / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "--max-strain" in commands and "--gap-factor" in commands


@pytest.fixture
def written_pages(monkeypatch) -> dict[str, str]:
    """The pages that are written from code and data, by their path in the guide."""
    monkeypatch.syspath_prepend(GUIDE)
    import reference_tables

    return reference_tables.pages()


@pytest.mark.slow
def test_every_option_of_help_is_explained(written_pages):
    """What `limber COMMAND --help` lists has a row with a meaning in the page of commands."""
    from limber.cli.main import main

    page = written_pages["reference/commands.md"]
    sections = dict(section.split("\n", 1) for section in re.split(r"^##+ limber ", page,
                                                                   flags=re.MULTILINE)[1:])

    def check(command: click.Command, words: str) -> int:
        if isinstance(command, click.Group):
            return sum(check(child, f"{words} {name}".strip())
                       for name, child in command.commands.items())
        told = command.get_help(click.Context(command, info_name=words))
        seen = set(re.findall(r"^ +(?:-\w, )?(--[a-z][a-z-]*)", told, re.MULTILINE))
        cells = [line.split(" | ") for line in sections[words].splitlines()
                 if line.startswith("| `")]
        rows = {word: meaning for names, meaning, *_ in cells
                for word in re.findall(r"--[a-z-]+", names)}
        lacking = [word for word in seen - {"--help", "--help-all"}
                   if len(rows.get(word, "").split()) < 3]
        assert not lacking, f"limber {words}: {lacking}"
        return len(seen)
    names = main.list_commands(click.Context(main))
    found = [check(main.get_command(click.Context(main), name), name) for name in names]
    assert sum(found) > 150


@pytest.mark.parametrize("page", ["explanation/accuracy.md", "explanation/decide.md"])
def test_pages_of_accuracy_are_those_of_their_data(page, written_pages):
    """`scripts/docs` writes them; a new table in worker/docs/data needs them again."""
    assert (GUIDE / page).read_text(encoding="utf-8") == written_pages[page]


@pytest.mark.parametrize("path", [GUIDE.parents[1] / "README.md", *sorted(GUIDE.rglob("*.md"))],
                         ids=lambda path: path.stem)
def test_sentences_are_short(path):
    """At most 30 words each, tables and code aside."""
    text = re.sub(r"```.*?```|<!--.*?-->|^\s*\|.*?$", "", path.read_text(encoding="utf-8"),
                  flags=re.DOTALL | re.MULTILINE)
    sentences = re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) |#)|(?<=[.?!:])\s+",
                         re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text))
    assert not [each for each in sentences if len(re.findall(r"\S*\w\S*", each)) > 30]


@pytest.mark.parametrize("path", sorted((GUIDE / "data").glob("*.json")), ids=lambda p: p.stem)
def test_data_of_accuracy_say_where_they_are_from(path):
    """Date, commit, seed and the number of trials: without them nobody can measure again."""
    record = json.loads(path.read_text(encoding="utf-8"))
    assert record["bench"] == path.stem and re.fullmatch(r"[0-9a-f]{10}", record["commit"])
    assert datetime.date.fromisoformat(record["date"]) and record["seed"] >= 0
    assert all(row["measure"] and row["measured"] for row in record["rows"] if row["count"])
    assert any(row["count"] for row in record["rows"])


def _figures_of(path):
    """The numbers with a unit in a page's own text: neither code nor what a bench's data write."""
    text = re.sub(r"```.*?```|<!-- [^>]*writes this. -->.*?<!-- End. -->|`[^`]*`", "",
                  path.read_text(encoding="utf-8"), flags=re.DOTALL)
    number = r"\d(?:[\d.,]| (?=000))*"
    return {" ".join(each.rstrip(",. ").split()) for each in re.findall(
        rf"(?<![\w.^]){number}(?: to {number})?(?: million)? ?(?:%|(?:{_UNITS})(?!\w))", text)}


def _is_as_stated(figure, source):
    """Whether a constant or a bench's row says the same; other sources are words."""
    if constant := re.fullmatch(r"([\w.]+):(\w+)(?: x (\S+))?", source):
        value = getattr(importlib.import_module(constant[1]), constant[2]) * float(constant[3] or 1)
        told = float(re.match(r"[\d., ]*\d", figure)[0].replace(",", "").replace(" ", ""))
        return math.isclose(told, value)
    if row := re.fullmatch(r"row (\w+): (.*)", source):
        rows = json.loads((GUIDE / "data" / f"{row[1]}.json").read_text(encoding="utf-8"))["rows"]
        number = re.match(r"[\d.]+", figure)[0]
        return any(number in each["measured"] for each in rows if each["measure"] == row[2])
    return source.partition(": ")[0] in ("measured", "cited", "example", "rule")


def test_every_number_of_the_text_has_a_source():
    """worker/docs/data/figures.toml names it: a new number goes in, a gone one out."""
    sources = tomllib.loads((GUIDE / "data" / "figures.toml").read_text(encoding="utf-8"))
    written = {"explanation/accuracy.md", "explanation/decide.md"} | {
        f"reference/{name}.md" for name in ("stages", "commands", "pull_toml", "cell_toml")}
    pages = {"README.md": GUIDE.parents[1] / "README.md"} | {
        name: path for path in sorted(GUIDE.rglob("*.md"))
        if (name := path.relative_to(GUIDE).as_posix()) not in written}
    found = {name: figures for name, path in pages.items() if (figures := _figures_of(path))}
    assert {name: sorted(each) for name, each in found.items()} == {
        name: sorted(each) for name, each in sources.items()}
    assert not [(name, figure, source) for name, each in sources.items()
                for figure, source in each.items() if not _is_as_stated(figure, source)]


def test_the_strains_of_species_are_those_of_the_code():
    """The table of `--wood` has every species that it takes, to two digits."""
    from limber.mechanics.materials.materials import SPECIES, strain_limit

    text = (GUIDE / "howto" / "limits.md").read_text(encoding="utf-8")
    told = dict(re.findall(r"^\| `(\w+)` \| (\S+) %", text, re.MULTILINE))
    assert told == {name: f"{100 * strain_limit(name):.2f}" for name, species in SPECIES.items()
                    if species.rupture_strain is not None}


def test_tutorials_are_executed_and_pictures_have_scripts():
    """Seven tutorials whose commands run when the guide is built; twelve pictures, whose scripts
    assert the numbers that they state."""
    tutorials = sorted((GUIDE / "tutorials").glob("*.md"))
    assert len(tutorials) >= 7
    assert all("```{run}" in path.read_text(encoding="utf-8") for path in tutorials)
    pictures = sorted((GUIDE / "gallery").glob("plot_*.py"))
    assert len(pictures) >= 12 and all({"plt.show()", "assert"} <= set(
        path.read_text(encoding="utf-8").split()) for path in pictures)


PAGE = """# A

```{file} say.py
import sys
print("said", 6 * 7); sys.exit(int(sys.argv[1]))
```

```{run}
:says: said 43
python say.py 0
```

```{run}
:exit: 3
python say.py 3
python say.py 4
```
"""


@pytest.mark.slow
def test_a_tutorials_commands_run_and_must_end_as_stated(tmp_path):
    """What they print is shown; another exit code is a warning, which fails `scripts/docs`."""
    pytest.importorskip("sphinx", reason="the extra docs is not installed")
    (tmp_path / "conf.py").write_text(f"import sys\nsys.path.insert(0, {str(GUIDE)!r})\n"
                                      "extensions = ['myst_parser', 'executed_commands']\n")
    (tmp_path / "index.md").write_text(PAGE, encoding="utf-8")
    done = subprocess.run([sys.executable, "-m", "sphinx", "-q", "-b", "text", tmp_path,
                           tmp_path / "out"], capture_output=True, text=True, check=False)
    shown = (tmp_path / "out" / "index.txt").read_text(encoding="utf-8")
    assert shown.count("said 42") == 3 and "does not say 'said 43'" in done.stderr
    assert "`python say.py 4` ended with exit code 4" in done.stderr
    assert done.stderr.count("WARNING") == 2
