"""The errors that the worker raises, read from its source."""

import ast
from pathlib import Path

WORKER = Path(__file__).parents[2] / "worker" / "limber"
STAGES = {"geometry": "reconstruct", "mechanics": "simulate", "reduced": "simulate",
          "recordings": "import-pull", "perception": "import-pull", "estimation": "estimate",
          "planning": "plan", "store": "plan", "session": "plan", "results": "report",
          "stages": "estimate"}
"""A stage of each room of the worker that a step of the tab can meet."""
_VALUE = "0.1234"


def told() -> list[tuple[str, str]]:
    """Return stage and text of each error, as far as a step of the tab can meet it.

    A value that is known only when it is raised is a number.
    """
    found = {}
    for room, stage in STAGES.items():
        for path in sorted((WORKER / room).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                    text = " ".join(filter(None, map(_text, node.exc.args)))
                    if text:
                        found[text] = stage
    return [(stage, text) for text, stage in found.items()]


def _text(node: ast.expr) -> str:
    """Return a text as it is raised; empty if all of it is made elsewhere."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        return "".join(part.value if isinstance(part, ast.Constant) else _VALUE
                       for part in node.values)
    if isinstance(node, ast.BinOp):
        return _text(node.left) + _text(node.right)
    return ""
