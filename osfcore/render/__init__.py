"""Rendering many fields on a table under one light: a plain reference and a fast path."""
