"""Poses and masks that other programs found: files of BOP, PoseCNN and plain JSON."""
