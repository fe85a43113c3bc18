"""The cell: where the robot stands, what it holds, what is in its way, and their calibration."""
