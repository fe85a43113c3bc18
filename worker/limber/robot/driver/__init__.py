"""The process that moves the robot, its guard, and the parent's side of its pipe."""
