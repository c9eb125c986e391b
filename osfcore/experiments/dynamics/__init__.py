"""Evaluation of predicted pushes."""
