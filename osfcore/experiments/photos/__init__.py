"""Evaluation of photographs, real ones and synthetic views of the calibration board."""
