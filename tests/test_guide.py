"""The guide builds without a warning, and explains every option and public name."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_the_guide_builds_without_a_warning(tmp_path):
    """Warnings are errors: dead references, pages in no table of contents, bad tables."""
    pytest.importorskip("sphinx", reason="the extra docs is not installed")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "-d",
         tmp_path / "doctrees", ROOT / "worker" / "docs", tmp_path / "html"],
        capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    commands = (tmp_path / "html" / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "--max-strain" in commands and "--contraction-points" in commands


def test_every_public_name_says_what_it_is():
    """All that `import limber` gives has a docstring."""
    import limber

    for name in limber.__all__:
        if name != "__version__":
            assert (getattr(limber, name).__doc__ or "").strip(), name
