"""Evaluation of rearrangement from goal images (paper, section 5.4)."""
