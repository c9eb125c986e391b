"""The paper's figures 5, 6 and 7, and more, in one report."""
