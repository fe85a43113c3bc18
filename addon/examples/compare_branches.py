"""Puts branches side by side in one scene and makes a table of their results, without a window.

    blender -b --python compare_branches.py -- FOLDER.branch FOLDER.branch ... -o SCENE.blend

The table is written beside the scene, as SCENE.csv.
"""

import argparse
import csv
import json
import sys
from pathlib import Path

import bpy

COLUMNS = ("branch", "length_m", "tet_count", "young_least_pa", "young_most_pa",
           "energy_saved_percent")


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="compare_branches.py")
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args(arguments)

    for folder in given.folders:
        bpy.ops.limber.open_result(directory=str(folder.resolve()))
    bpy.ops.limber.side_by_side()
    bpy.ops.wm.save_as_mainfile(filepath=str(given.output.resolve()))
    with open(given.output.with_suffix(".csv"), "w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream)
        table.writerow(COLUMNS)
        table.writerows(numbers(folder) for folder in given.folders)


def numbers(folder: Path) -> list:
    """Return the results in a folder's branch.json, in the order of the columns."""
    manifest = json.loads((folder / "branch.json").read_text(encoding="utf-8"))
    results = {key: entry["result"] for key, entry in manifest["stages"].items()}
    made = results.get("reconstruct") or results.get("mesh") or {}
    young = results.get("estimate", {}).get("young_pa")
    saved = [result.get("energy_saved_percent") for key, result in results.items()
             if key.startswith("plan:")]
    return [manifest["name"], made.get("length_m"), made.get("tet_count"),
            min(young) if young else None, max(young) if young else None,
            saved[-1] if saved else None]


if __name__ == "__main__":
    try:
        main(sys.argv[sys.argv.index("--") + 1:])
    except Exception as error:
        # Blender itself would end with 0, whatever the error.
        sys.exit(f"{Path(__file__).name}: {error}")
