"""Robot: kinematics, the cell, driver, sensors, guard, and a virtual controller to test it on."""
