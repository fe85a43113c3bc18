"""After an installation the worker compiles once, in the background, and never again."""

import importlib
import json
import sys
import time

import pytest
from tests.addon.test_panels import Layout


@pytest.fixture()
def warming(bpy, registered, tmp_path, monkeypatch):
    """The module, its worker a script that writes down how it was called."""
    module = importlib.import_module("limber_addon.jobs.warming")
    script = tmp_path / "worker.py"
    script.write_text(
        "import json, sys\n"
        f"open({str(tmp_path / 'calls')!r}, 'a').write(json.dumps(sys.argv[1:]) + '\\n')\n"
        "print(json.dumps({'progress': 0.5, 'message': 'compiling'}), flush=True)\n"
        "import os, time; time.sleep(0.2)\n"
        f"broken = os.path.exists({str(tmp_path / 'broken')!r})\n"
        "print(json.dumps({'status': 'failed' if broken else 'done', 'error': 'x'}))\n"
        "sys.exit(3 if broken else 0)\n")
    command = [sys.executable, str(script)]
    monkeypatch.setattr(importlib.import_module("limber_addon.preferences"), "worker_command",
                        lambda: command)
    monkeypatch.setattr(bpy.utils, "extension_path_user",
                        lambda _key, path="", create=False: str(tmp_path / path))
    yield module
    module.unregister()


def _to_the_end(warming):
    shown = []
    end = time.monotonic() + 15.0
    while warming.look() is not None:
        layout = Layout()
        warming.draw(layout)
        shown += layout.names("label")
        assert time.monotonic() < end
        time.sleep(0.02)
    return shown


def test_it_compiles_once(warming, tmp_path):
    """With progress, beside the jobs; where it failed, the next start tries again."""
    (tmp_path / "broken").touch()
    assert warming.begin()
    assert "Compiling 50 %" in _to_the_end(warming)
    (tmp_path / "broken").unlink()
    assert warming.begin() and _to_the_end(warming)
    assert not warming.begin() and warming.current() is None
    calls = [json.loads(line) for line in (tmp_path / "calls").read_text().splitlines()]
    assert calls == [["doctor", "--warm", "--json", "--progress", "json"]] * 2
    jobs = importlib.import_module("limber_addon.jobs.jobs")
    assert not jobs.is_running(), "nothing waits for it"
