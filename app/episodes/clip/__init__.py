"""A clip of an episode that one would post: the 3D view, the goal, the table, the curve, and what it came to."""
