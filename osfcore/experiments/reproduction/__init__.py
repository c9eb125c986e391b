"""The paper's experiments in one report."""
