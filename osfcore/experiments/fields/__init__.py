"""Evaluation of fields."""
