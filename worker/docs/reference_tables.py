"""A Sphinx extension: reference pages written from the code, so that they cannot go stale.

`commands.md` comes from the stages' schemas and the other commands' options; `pull_toml.md` and
`cell_toml.md` from the models that read those files; ``explanation/accuracy.md`` and
``explanation/decide.md`` from the tables of the benches.
"""

from pathlib import Path
from typing import Any, get_args, get_origin

import click
from accuracy_page import accuracy_page
from decision_page import decision_page
from pydantic import BaseModel
from pydantic.fields import FieldInfo

HERE = Path(__file__).parent


def setup(app: Any) -> dict[str, Any]:
    """Write the pages before Sphinx reads its sources."""
    app.connect("builder-inited", lambda _app: write_pages(HERE))
    return {"parallel_read_safe": True}


def write_pages(folder: Path) -> None:
    """Write all generated pages into ``folder``; a page that has not changed is not touched."""
    for name, text in pages().items():
        path = folder / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def pages() -> dict[str, str]:
    """Return the text of each generated page by its path in the guide."""
    from limber.cell.cell_file import Cell
    from limber.recordings.recording import PullEntry

    return {
        "explanation/accuracy.md": accuracy_page(),
        "explanation/decide.md": decision_page(),
        "reference/commands.md": commands_page(),
        "reference/pull_toml.md": _model_page("pull.toml", PullEntry, (
            "The settings of a recording, in `pulls/NAME/pull.toml`. `limber import-pull` and "
            "`limber record` write it. `import-pull --pull-toml mine.toml` replaces entries by "
            "yours. Do not edit the copy in the branch folder: it is compared with its checksum.")),
        "reference/cell_toml.md": _model_page("The cell file", Cell, (
            "`cell.toml` says which robot stands where, what it holds, and what it must not "
            "exceed. Lengths are in metres, angles in radians, masses in kilograms.")),
    }


def commands_page() -> str:
    """Return the page of all commands with all of their options."""
    from limber.cli.main import main

    parts = ["# Commands\n",
             "Every command prints this with `limber COMMAND --help-all`. Exit codes: 0 done, 2 "
             "wrong usage or input, 3 the work failed, 4 stopped for safety, 130 cancelled.\n"]
    context = click.Context(main, info_name="limber")
    for name in main.list_commands(context):
        parts.extend(_command(f"limber {name}", main.get_command(context, name)))
    return "\n".join(parts) + "\n"


def _command(name: str, command: click.Command | None) -> list[str]:
    assert command is not None, name
    summary = (command.help or "").split("\n\n")[0].replace("\n", " ")
    parts = [f"## {name}\n", f"{_escaped(summary)}\n"]
    if isinstance(command, click.Group):
        context = click.Context(command, info_name=name)
        for child in command.list_commands(context):
            lines = _command(f"{name} {child}", command.get_command(context, child))
            parts += [f"#{line}" if line.startswith("## ") else line for line in lines]
        return parts
    rows = [_option_row(option) for option in command.params
            if not getattr(option, "hidden", False)]
    if rows:
        parts += ["| option | meaning | default |", "|---|---|---|", *rows, ""]
    return parts


def _option_row(option: click.Parameter) -> str:
    names = ", ".join(f"`{word}`" for word in [*option.opts, *option.secondary_opts])
    if isinstance(option, click.Argument):
        names = f"`{option.make_metavar(click.Context(click.Command('limber')))}`"
    default = option.default
    shown = "" if default is None or default is False or callable(default) or "Sentinel" in str(
        type(default)) else f"`{default}`"
    return f"| {names} | {_escaped(getattr(option, 'help', None) or '')} | {_escaped(shown)} |"


def _model_page(title: str, model: type[BaseModel], introduction: str) -> str:
    parts = [f"# {title}\n", f"{introduction}\n", *_table("", model)]
    return "\n".join(parts) + "\n"


def _table(prefix: str, model: type[BaseModel]) -> list[str]:
    """Rows of a model's own entries, then a section for each model inside it."""
    rows, inner = [], []
    for name, field in model.model_fields.items():
        models, is_list = _models(field.annotation)
        if models:
            heading = f"[[{prefix}{name}]]" if is_list else f"[{prefix}{name}]"
            inner += [(prefix + name, heading, child) for child in models]
            continue
        rows.append(f"| `{name}` | {_kind(field)} | {_default(field)} "
                    f"| {_escaped(field.description or '')} |")
    parts = []
    if rows:
        parts = ["| key | type | default | meaning |", "|---|---|---|---|", *rows, ""]
    for name, heading, child in inner:
        about = (child.__doc__ or "").strip().split("\n\n")[0]
        parts += [f"## {heading}\n", f"{_escaped(about)}\n",
                  *_table(f"{name}.", child)]
    return parts


def _models(annotation: Any) -> tuple[list[type[BaseModel]], bool]:
    """The models that an entry may hold, and whether it is a list of them."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation], False
    inner = [_models(part) for part in get_args(annotation)]
    return ([model for models, _ in inner for model in models],
            get_origin(annotation) in (tuple, list) or any(is_list for _, is_list in inner))


def _kind(field: FieldInfo) -> str:
    kind = field.annotation
    text = kind.__name__ if isinstance(kind, type) else str(kind)
    for word in ("typing.", "NoneType"):
        text = text.replace(word, "")
    return f"`{text}`".replace("|", "\\|")


def _default(field: FieldInfo) -> str:
    return "required" if field.is_required() else f"`{field.default!r}`".replace("|", "\\|")


def _escaped(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")
