"""Errors of poses and images, and success of rearrangements."""
