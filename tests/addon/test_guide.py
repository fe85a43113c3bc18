"""Each panel's help: a page of the guide that is there, in a checkout and in the zip."""

import subprocess
import sys
from html.parser import HTMLParser

import pytest
from tests.addon.conftest import ROOT, part


class Links(HTMLParser):
    """What a page links to, and the anchors that it has."""

    def __init__(self, text):
        super().__init__()
        self.links, self.anchors, self.ends = [], set(), []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        self.links += [named[name] for name in ("href", "src") if name in named]
        self.anchors |= {named["id"]} if "id" in named else set()


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The guide as the zip has it."""
    folder = tmp_path_factory.mktemp("guide")
    subprocess.run([sys.executable, ROOT / "worker" / "docs" / "plain_pages.py", folder],
                   check=True)
    return folder


def test_every_panel_has_a_page(bpy, registered, pages):
    """The button in each panel's header opens a page that the checkout and the zip have."""
    guide = part("panels.guide")
    steps = part("jobs.steps").STEPS
    names = {*guide._PAGES.values(), *(step.page for step in steps), "index"}
    assert len(names) > 8
    for name in names:
        assert (pages / f"{name}.html").is_file(), name
        assert guide.page_path(name) is not None, name
    assert bpy.ops.limber.help(page="howto/scan") == {"FINISHED"}
    with pytest.raises(RuntimeError, match="does not include the guide's page howto/none"):
        bpy.ops.limber.help(page="howto/none")


def test_its_pages_lead_nowhere_else(pages):
    """Every link of a page leads to a page or picture that is there, or to an address."""
    read = {page: Links(page.read_text(encoding="utf-8")) for page in pages.rglob("*.html")}
    assert len(read) > 20
    broken = [(page.name, link) for page, found in read.items() for link in found.links
              if ":" not in link and not _leads(page, link, read)]
    assert broken == []


def _leads(page, link, read):
    file, _, anchor = link.partition("#")
    linked = (page.parent / file).resolve() if file else page
    return linked.is_file() and (not anchor or anchor in read[linked].anchors)
