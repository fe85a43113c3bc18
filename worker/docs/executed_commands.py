"""A Sphinx extension: commands of a tutorial, run while its page is read.

Three directives work in one folder for each page, which begins empty:

``{run}``
    Runs its lines with the shell's rules for words and nothing else of a shell: a line begins with
    ``limber`` or ``python``. The page shows the lines and the end of what each printed. The option
    ``exit`` states the expected exit code (default 0), ``lines`` how many lines are shown, ``says``
    a text that the last line has to print, such as a number that the page states.
``{file} NAME``
    Writes its content into the folder, and shows it.
``{made} NAME``
    Shows a picture that the commands before it have made.

A command that ends otherwise than expected is a warning, and so fails `scripts/docs`. With
``-D run_commands=0`` nothing is run and the pages show the commands alone. Tutorials move no robot
but the virtual one.
"""

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

from docutils import nodes
from docutils.parsers.rst import Directive, directives
from sphinx.util import logging

LOG = logging.getLogger(__name__)
RUNS = "_runs"
"""The folder below the guide's sources in which each page has its own."""
SECONDS = 400
STOPPED_FOR_SAFETY = 4
"""The exit code of a robot that was stopped: a busy computer can do that, so it is tried again."""


def setup(app: Any) -> dict[str, Any]:
    """Register the directives; a page that is read again begins with an empty folder."""
    app.add_config_value("run_commands", True, "env", (bool, int, str))
    for name, directive in (("run", Run), ("file", File), ("made", Made)):
        app.add_directive(name, directive)
    app.connect("source-read", lambda app, page, _text: shutil.rmtree(
        _folder(app.env, page), ignore_errors=True))
    return {"parallel_read_safe": True}


class Run(Directive):
    """Run commands and show what they print."""

    has_content = True
    told = ""
    option_spec: ClassVar[dict[str, Any]] = {
        "exit": directives.nonnegative_int, "lines": directives.positive_int,
        "says": directives.unchanged_required}

    def run(self) -> list[nodes.Node]:
        """Return a block of the commands, and one of the output of each that prints."""
        env = self.state.document.settings.env
        shown: list[nodes.Node] = []
        for line in self.content:
            block = nodes.literal_block(line, line, language="shell")
            shown.append(block)
            if not _enabled(env):
                continue
            told = self._output_of(env, line.partition(" #")[0])
            if told:
                shown.append(nodes.literal_block(told, told, language="text",
                                                 classes=["command-output"]))
        if _enabled(env) and (asked := self.options.get("says", "")) not in self.told:
            LOG.warning("`%s` does not say %r:\n%s", line, asked, self.told[-1500:],
                        location=(env.docname, self.lineno))
        return shown

    def _output_of(self, env: Any, line: str) -> str:
        """Run one line; return the end of what it printed."""
        folder = _folder(env, env.docname)
        folder.mkdir(parents=True, exist_ok=True)
        word, *words = shlex.split(line)
        program = {"limber": [sys.executable, "-m", "limber"], "python": [sys.executable]}[word]
        try:
            done = _tried([*program, *words], folder)
        except subprocess.TimeoutExpired:
            LOG.warning("`%s` takes over %d s", line, SECONDS, location=(env.docname, self.lineno))
            return ""
        text = (done.stderr + done.stdout).replace(f"{folder}{os.sep}", "").rstrip()
        if done.returncode != self.options.get("exit", 0):
            LOG.warning("`%s` ended with exit code %d:\n%s", line, done.returncode, text[-1500:],
                        location=(env.docname, self.lineno))
        self.told = text
        lines = text.splitlines()
        kept = self.options.get("lines", 14)
        return "\n".join(lines if len(lines) <= kept else ["...", *lines[-kept:]])


def _tried(command: list[str], folder: Path) -> subprocess.CompletedProcess:
    """Run a command; once more, from the same files, where a robot was stopped."""
    before = set(folder.iterdir())
    for _ in range(2):
        for made in set(folder.iterdir()) - before:
            shutil.rmtree(made) if made.is_dir() else made.unlink()
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False,
                              timeout=SECONDS,
                              env={**os.environ, "COLUMNS": "96", "NO_COLOR": "1"})
        if done.returncode != STOPPED_FOR_SAFETY:
            break
    return done


class File(Directive):
    """Write a file and show it."""

    has_content = True
    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return a block of the content below the file's name."""
        env, (name,) = self.state.document.settings.env, self.arguments
        text = "\n".join(self.content) + "\n"
        if _enabled(env):
            path = _folder(env, env.docname) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        kind = {".toml": "toml", ".py": "python", ".json": "json"}.get(Path(name).suffix, "text")
        title = nodes.paragraph("", "", nodes.literal(name, name), nodes.Text(":"))
        return [title, nodes.literal_block(text, text, language=kind)]


class Made(Directive):
    """Show a picture that was made."""

    required_arguments = 1
    option_spec: ClassVar[dict[str, Any]] = {"alt": directives.unchanged_required}

    def run(self) -> list[nodes.Node]:
        """Return the picture; none where nothing was run."""
        env = self.state.document.settings.env
        if not _enabled(env):
            return []
        path = _folder(env, env.docname) / self.arguments[0]
        if not path.is_file():
            LOG.warning("there is no picture %s", path, location=(env.docname, self.lineno))
            return []
        return [nodes.image(uri=f"/{path.relative_to(env.srcdir).as_posix()}",
                            alt=self.options.get("alt", path.stem))]


def _enabled(env: Any) -> bool:
    return str(env.config.run_commands) not in ("0", "False")


def _folder(env: Any, page: str) -> Path:
    return Path(env.srcdir, RUNS, page.replace("/", "-"))
