"""Results for people and other programs: report, Blender scene, exports, motion files."""
