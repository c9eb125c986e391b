"""`osf robot`: look at a robot, and drive it."""
