"""Arms of Universal Robots: kinematics, the RTDE protocol and samples of their state."""
