"""What people and other programs look at: report, Blender scene, exports, motion files."""
