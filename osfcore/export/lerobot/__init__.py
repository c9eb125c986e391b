"""Episodes as data sets of LeRobot, format v3.0, written without LeRobot."""
