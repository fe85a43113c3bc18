"""Puts into the wheel what is no Python of the worker: the kernels' libraries, and the add-on's
modules, which `limber scene` has a process with bpy run.

The list of packages that it was tested with (SBOM) goes beside them. Everything else stands
in pyproject.toml. LIMBER_KERNEL_TARGETS names the systems whose libraries the wheel
brings, `all` or some of worker/kernels/build.py; without it that is this machine's.
"""

import os
import runpy
from pathlib import Path

from setuptools import setup
from setuptools.command.bdist_wheel import bdist_wheel, get_platform
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parent
KERNELS = runpy.run_path(str(ROOT / "worker" / "kernels" / "build.py"))
NAMED = os.environ.get("LIMBER_KERNEL_TARGETS", "").split()
TARGETS = list(KERNELS["TARGETS"]) if NAMED == ["all"] else NAMED


class OneForEveryPython(bdist_wheel):
    """A wheel for each Python; for this system only, unless the libraries' were named."""

    def get_tag(self):
        system = get_platform(self.bdist_dir).replace("-", "_").replace(".", "_")
        return "py3", "none", "any" if TARGETS else system


class BuildWithAddon(build_py):
    """Builds the libraries; copies ``addon/`` to ``limber/results/scene/addon/``."""

    def run(self):
        super().run()
        if self.editable_mode:
            return
        self._add_libraries()
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

    def _add_libraries(self):
        made = ROOT / "build" / "kernels" if TARGETS else ROOT / "worker" / "limber" / "kernels"
        KERNELS["build"](made, *TARGETS)
        for target in TARGETS or [KERNELS["host"]()]:
            for library in (*made.glob(f"{target}.[sd]*"), *made.glob(f"{target}-v3.[sd]*")):
                if library.suffix != ".digest":
                    self.copy_file(str(library), str(Path(self.build_lib, "limber", "kernels")))

    def _write_sbom(self):
        known = runpy.run_path(str(ROOT / "scripts" / "check_dependencies"))
        lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
        Path(self.build_lib, "limber", "sbom.cdx.json").write_text(
            known["sbom"](known["pins"](lock), self.distribution.get_version()), encoding="utf-8")


setup(cmdclass={"build_py": BuildWithAddon, "bdist_wheel": OneForEveryPython},
      setup_requires=[] if KERNELS["compiler"]() and not TARGETS else ["ziglang"])
