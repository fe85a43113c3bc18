"""Every command that README and guide show is one that Limber understands; links lead somewhere.

`scripts/bench worker --only readme` runs those of the README.
"""

import json
import re
import shlex
from pathlib import Path

import click
import pytest

from benchmarks.worker import shown_commands
from limber.cli.main import main
from limber.stages.registry import stage_table

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
GUIDE = sorted(path for path in (ROOT / "worker" / "docs").rglob("*.md")
               if path.name not in ("commands.md", "pull_toml.md", "cell_toml.md"))
"""Without the pages that are written from the code."""


def _commands() -> list[str]:
    lines = [line for path in (README, *GUIDE)
             for line in shown_commands(path.read_text(encoding="utf-8"))]
    return list(dict.fromkeys(lines))


@pytest.mark.parametrize("line", _commands())
def test_a_shown_command_is_understood(line):
    """Its options are there and take what is given; nothing is run."""
    _, name, *words = shlex.split(line)
    command = main.get_command(click.Context(main), name)
    assert command is not None, name
    while isinstance(command, click.Group):
        name, *words = words
        command = command.get_command(click.Context(command), name)
        assert command is not None, name
    command.make_context(name, words)


def test_the_readmes_figures_are_those_of_runs(monkeypatch):
    """Run scripts/make_readme_figures where the example or a table in worker/docs/data is new."""
    monkeypatch.syspath_prepend(ROOT / "worker" / "docs")
    import readme_figures

    text = README.read_text(encoding="utf-8")
    for begin, part in readme_figures.PARTS.items():
        _, _, rest = text.partition(f"{begin}\n")
        assert rest.partition(f"\n{readme_figures.END}")[0] == part()


@pytest.mark.parametrize("page", ["light", "dark"])
def test_the_readmes_picture_moves_and_is_small(page):
    """scripts/make_moving_picture makes it: four steps, 15 s, under 2.5 MB."""
    from PIL import Image

    path = ROOT / "worker" / "docs" / "pictures" / f"limber_{page}.webp"
    assert path.name in README.read_text(encoding="utf-8") and path.stat().st_size < 2.5e6
    picture = Image.open(path)
    assert picture.n_frames >= 150 and picture.width >= 800


def test_the_readme_says_how_many_rows_of_other_generators_miss_a_limit():
    rows = json.loads((ROOT / "worker/docs/data/worlds.json").read_text(encoding="utf-8"))["rows"]
    met = [row["met"] for row in rows if "(left out)" in row["measure"]]
    text = " ".join(README.read_text(encoding="utf-8").split())
    assert f"{met.count(False)} of the {len(met)} rows of other generators miss" in text


def test_a_figure_without_a_row_is_an_error(monkeypatch):
    """A bench that says it otherwise does not leave an old figure."""
    monkeypatch.syspath_prepend(ROOT / "worker" / "docs")
    import readme_figures

    monkeypatch.setitem(readme_figures.FIGURES, "forks",
                        readme_figures.Figure("scans", "one-sided", r"(no such words)"))
    with pytest.raises(LookupError, match="no such words"):
        readme_figures.table()


def _said(pattern: str) -> float:
    """A number of the README's prose."""
    return float(re.search(pattern, " ".join(README.read_text(encoding="utf-8").split()))[1])


def test_the_readmes_times_and_sizes_are_as_measured():
    """Within a quarter of what `scripts/bench worker --only demo` has found."""
    rows = json.loads((ROOT / "worker/docs/data/worker.json").read_text(encoding="utf-8"))["rows"]
    measured = {row["measure"]: row["measured"] for row in rows}
    spent = re.search(r"; (\d+) s", measured["limber demo: by the clock; processor time"])[1]
    size = measured["all packages, installed"].removesuffix(" GB")
    assert _said(r"demo takes (\d+) seconds of processor time") == pytest.approx(float(spent),
                                                                                 rel=0.25)
    assert _said(r"and (\d\.\d) GB of disk") == pytest.approx(float(size), rel=0.25)
    memory = measured["limber demo: largest memory of a process"].removesuffix(" MB")
    assert _said(r"and (\d\.\d) GB of memory") == pytest.approx(float(memory) / 1000, rel=0.25)


def test_the_readme_is_short_and_shows_commands():
    """It is read in a minute: at most 150 lines, no sentence of over 30 words."""
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    assert len(shown_commands(text)) > 5
    prose = re.sub(r"^```.*?^```|^\|.*?$|^#.*?$|^!?\[.*?$|^- .*?(?=\n\n)", "", text,
                   flags=re.MULTILINE | re.DOTALL)
    prose = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", prose)
    long = [sentence for sentence in re.split(r"(?<=[.:!?])\s+|\n\n", prose)
            if len(sentence.split()) > 30]
    assert not long


@pytest.mark.parametrize("path", [README, ROOT / "CONTRIBUTING.md", *GUIDE],
                         ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    """Every relative link of README and guide is a file that is there, or is written from code."""
    text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"),
                  flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)#:]+?)(?:#[^)]*)?\)", text):
        found = path.parent / target
        assert found.exists() or found.name in ("commands.md", "pull_toml.md", "cell_toml.md"), (
            f"{path.name} links {target}")


def test_the_table_of_stages_is_the_registrys():
    """Run scripts/make_addon_schema when a stage has changed."""
    text = (ROOT / "worker/docs/reference/stages.md").read_text(encoding="utf-8")
    _, _, rest = text.partition("<!-- Stages: scripts/make_addon_schema writes this table. -->\n")
    assert rest.partition("\n<!-- End of stages. -->")[0] == stage_table()


def test_every_command_has_an_example():
    """Whatever `limber --help` lists is shown once."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in (README, *GUIDE))
    lacking = [name for name in main.list_commands(click.Context(main))
               if not re.search(rf"limber {name}[ `\n]", text)]
    assert not lacking
