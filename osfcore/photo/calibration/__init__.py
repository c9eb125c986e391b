"""Calibration of a camera from several photographs of the board, with the error to expect on the table."""
