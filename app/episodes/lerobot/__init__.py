"""Episodes as data sets of LeRobot."""
