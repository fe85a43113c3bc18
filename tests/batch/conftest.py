"""What tests of batches share: branch folders, and a batch in the test's own process, which is
quick and whose disk can be made to fail.
"""

import shutil
from concurrent.futures import Future

import pytest

from limber.batch import run
from limber.core.progress import SILENT


class Here:
    """A pool that runs tasks in this process; ``before`` is called before each."""

    worker_count = 1
    before = staticmethod(lambda task, folder: None)

    def __init__(self, *_given, **_named):
        pass

    def submit(self, function, task, folder, *, limits):
        future = Future()
        Here.before(task, folder)
        try:
            future.set_result(function(task, folder, SILENT))
        except Exception as error:
            future.set_exception(error)
        return future

    def cancel(self, *, wait_for_end):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_error):
        pass


@pytest.fixture
def here(monkeypatch):
    """Batches run in this process; returns what runs their tasks."""
    monkeypatch.setattr(run, "Pool", Here)
    return Here


@pytest.fixture
def two_branches(tmp_path, branch_template):
    """A folder with ``one.branch`` and ``two.branch``."""
    for name in ("one", "two"):
        shutil.copytree(branch_template, tmp_path / f"{name}.branch")
    return tmp_path


@pytest.fixture
def orchard(two_branches, request):
    """Two branch folders, and the module's job file for them."""
    (two_branches / "jobs.toml").write_text(request.module.JOBS)
    return two_branches
