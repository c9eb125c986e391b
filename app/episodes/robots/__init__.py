"""Episodes with a robot, of which nobody knows the truth."""
