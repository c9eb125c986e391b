"""Evaluation on real photographs."""
