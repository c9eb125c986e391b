"""The effect of pushes: paper section 4.3, equations 7 and 8, as a graph network over object poses."""
