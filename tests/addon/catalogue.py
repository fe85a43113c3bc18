"""The errors that the worker raises, read from its source."""

import ast
from pathlib import Path

from limber.core.errors import Command, Option, Text

WORKER = Path(__file__).parents[2] / "worker" / "limber"
STAGES = {"geometry": "reconstruct", "mechanics": "simulate", "reduced": "simulate",
          "recordings": "import-pull", "perception": "import-pull", "estimation": "estimate",
          "planning": "plan", "store": "plan", "session": "plan", "results": "report",
          "stages": "estimate"}
"""A stage of each room of the worker that a step of the tab can meet."""
_VALUE = "0.1234"
_PARTS = {"Text": Text, "Option": Option, "Command": Command}


def told() -> list[tuple[str, list]]:
    """Return stage and parts of each error, as far as a step of the tab can meet it.

    A value that is known only when it is raised is a number.
    """
    found = {}
    for room, stage in STAGES.items():
        for path in sorted((WORKER / room).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                    made = node.exc.func.value if _name(node.exc).endswith(").at") else node.exc
                    message = Text(*(part for each in made.args for part in (_made(each), " ")))
                    if message.strip():
                        found[message] = stage, message.as_json()
    return list(found.values())


def _name(node: ast.Call) -> str:
    return ast.unparse(node.func)


def _made(node: ast.expr) -> object:
    """Return a part of a message as it is raised."""
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(str(_made(part)) for part in node.values)
    kind = _PARTS.get(_name(node)) if isinstance(node, ast.Call) else None
    return kind(*map(_made, node.args)) if kind else _VALUE
