"""Writes the guide's pages as plain HTML, for reading without a network: the extension has them.

    python worker/docs/plain_pages.py FOLDER

Pages that Sphinx generates (the interface in Python) and executed output are not among them.
"""

import re
import shutil
import sys
from pathlib import Path

from markdown_it import MarkdownIt

HERE = Path(__file__).parent
FOLDERS = ("tutorials", "howto", "explanation", "reference")
_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{title}</title>
<style>body {{ font: 16px/1.5 sans-serif; max-width: 50em; margin: 2em auto; padding: 0 1em }}
table {{ border-collapse: collapse }} th, td {{ border: 1px solid #ccc; padding: .2em .5em;
vertical-align: top; text-align: left }} pre {{ background: #f4f4f4; padding: .6em;
overflow-x: auto }} img {{ max-width: 100% }}</style>
<p><a href="{index}">Limber's guide</a></p>
{body}</html>
"""


def main(target: Path) -> None:
    """Write all pages into a folder, with an index."""
    pages = [path for folder in FOLDERS for path in sorted((HERE / folder).glob("*.md"))
             if "{eval-rst}" not in path.read_text(encoding="utf-8")]
    titles = {path: _title(path) for path in pages}
    for path in pages:
        page = target / path.relative_to(HERE).with_suffix(".html")
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text(_PAGE.format(title=titles[path], index="../index.html",
                                     body=_body(path, page, set(pages))), encoding="utf-8")
    listed = "".join(
        f"<h2>{folder.capitalize()}</h2><ul>" + "".join(
            f'<li><a href="{folder}/{path.stem}.html">{title}</a></li>'
            for path, title in titles.items() if path.parent.name == folder) + "</ul>"
        for folder in FOLDERS)
    (target / "index.html").write_text(_PAGE.format(
        title="Limber's guide", index="index.html", body=listed), encoding="utf-8")


def _title(path: Path) -> str:
    return path.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")


def _body(path: Path, page: Path, pages: set[Path]) -> str:
    """Return a page's HTML: links lead to other pages written, pictures are copied beside it."""
    tokens = MarkdownIt("commonmark").enable("table").parse(
        re.sub(r"^```\{\w+\}", "```", path.read_text(encoding="utf-8"), flags=re.M))
    for token in (child for each in tokens for child in each.children or ()):
        name = {"link_open": "href", "image": "src"}.get(token.type)
        link = str(token.attrs.get(name, "")) if name else ""
        if not link or ":" in link or link.startswith("#"):
            continue
        file, _, place = link.partition("#")
        linked = (path.parent / file).resolve()
        if token.type == "image":
            shutil.copy(linked, page.parent)
            token.attrs[name] = linked.name
        elif linked in pages:
            token.attrs[name] = f"{file.removesuffix('.md')}.html" + (f"#{place}" if place else "")
        else:
            # Not among these pages: its text stays.
            del token.attrs[name]
    html = MarkdownIt("commonmark").renderer.render(tokens, MarkdownIt().options, {})
    return re.sub(r"<h(\d)>(.*?)</h\1>", lambda found: (
        f'<h{found[1]} id="{_anchor(found[2])}">{found[2]}</h{found[1]}>'), html)


def _anchor(title: str) -> str:
    """Return a heading's anchor, as in the guide's links."""
    words = re.sub(r"<[^>]+>|[^\w\s-]", "", title).strip().lower()
    return re.sub(r"\s+", "-", words)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
