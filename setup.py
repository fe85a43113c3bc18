"""Puts the add-on's modules into the wheel: `limber scene` has a process with bpy run them.

The list of packages that it was tested with (SBOM) goes beside them. Everything else stands
in pyproject.toml.
"""

import runpy
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parent


class BuildWithAddon(build_py):
    """Copies ``addon/`` to ``limber/results/scene/addon/``; a checkout has it."""

    def run(self):
        super().run()
        if self.editable_mode:
            return
        kinds = (".py", ".toml", ".json")
        sources = sorted(p for p in (ROOT / "addon").rglob("*") if p.suffix in kinds)
        if not sources:
            raise FileNotFoundError("The folder addon/ is not beside setup.py; the wheel needs it.")
        addon = Path(self.build_lib, "limber", "results", "scene", "addon")
        for source in sources:
            target = addon / source.relative_to(ROOT / "addon")
            self.mkpath(str(target.parent))
            self.copy_file(str(source), str(target))
        # It reads tables of points as the worker does.
        self.copy_file(str(ROOT / "worker" / "limber" / "core" / "files" / "text_columns.py"),
                       str(addon))
        self._write_sbom()

    def _write_sbom(self):
        known = runpy.run_path(str(ROOT / "scripts" / "check_dependencies"))
        lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
        Path(self.build_lib, "limber", "sbom.cdx.json").write_text(
            known["sbom"](known["pins"](lock), self.distribution.get_version()), encoding="utf-8")


setup(cmdclass={"build_py": BuildWithAddon})
