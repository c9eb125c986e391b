"""The paper's experiments and the speed figures: what the parts reach, measured the same way every time."""
