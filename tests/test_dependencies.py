"""scripts/check_dependencies: what a release brings, its licences, and what is known against it."""

import importlib.machinery
import importlib.util
import json
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def check():
    """The script, imported."""
    loader = importlib.machinery.SourceFileLoader("check_dependencies",
                                                  str(ROOT / "scripts" / "check_dependencies"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader(loader.name, loader))
    loader.exec_module(module)
    return module


def test_every_package_of_the_lock_is_pinned_with_hashes(check):
    """With a licence that goes with ours, and no known advisory."""
    locked = check.pins((ROOT / "requirements.lock").read_text())
    assert len(locked) > 50 and all(pin.hashes for pin in locked)
    assert check.licence_troubles(locked) == []
    known = tomllib.loads((ROOT / "scripts" / "advisories.toml").read_text())["advisory"]
    assert check.advisory_troubles(locked, known) == []
    assert {each["package"] for each in known} <= {pin.name for pin in locked}


def test_what_is_wrong_is_named(check, monkeypatch):
    """An old version, a licence that does not go with ours, an entry without a pin."""
    old = check.pins("filelock==3.20.0 \\\n    --hash=sha256:" + "0" * 64 + "\n")
    known = [{"package": "filelock", "id": "CVE-1", "mended": "3.20.1", "about": "links"}]
    assert check.advisory_troubles(old, known) == [
        "filelock 3.20.0: CVE-1 (links); mended in 3.20.1"]
    monkeypatch.setattr(check, "licence_of", lambda _name: "Proprietary")
    assert check.licence_troubles(old) == [
        "filelock: licence 'Proprietary' is not known to go with GPL-3.0-or-later"]
    with pytest.raises(SystemExit, match="not a pinned package"):
        check.pins("filelock>=3\n")


def test_an_audit_without_answers_is_no_audit(check, monkeypatch, capsys):
    """pip-audit finds no vulnerabilities where it reaches no data; then that is printed."""
    told = {"dependencies": [
        {"name": "filelock", "skip_reason": "not found"},
        {"name": "pillow", "version": "9.0", "vulns": [{"id": "CVE-1"}]}]}
    monkeypatch.setattr(check.shutil, "which", lambda name: name)
    monkeypatch.setattr(check.subprocess, "run", lambda *given, **named: SimpleNamespace(
        stdout=json.dumps(told), stderr="", returncode=0))
    assert check.audited() == ["pillow 9.0: CVE-1"]
    assert "no answer on 1 of 2 packages: filelock" in capsys.readouterr().out


def test_the_list_of_packages_names_each_with_its_hashes(check):
    """CycloneDX: name, version, hashes."""
    content = json.loads(check.sbom(check.pins((ROOT / "requirements.lock").read_text()), "9.9"))
    assert content["bomFormat"] == "CycloneDX"
    assert content["metadata"]["component"]["version"] == "9.9"
    numpy = next(part for part in content["components"] if part["name"] == "numpy")
    assert numpy["purl"] == f"pkg:pypi/numpy@{numpy['version']}" and numpy["hashes"]
