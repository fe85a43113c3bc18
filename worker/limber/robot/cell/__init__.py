"""The cell: robot base, gripper, obstacles and their calibration."""
