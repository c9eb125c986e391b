"""Evaluation of estimators."""
