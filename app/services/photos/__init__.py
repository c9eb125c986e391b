"""Photographs of tables: what is marked in them, what is found, and what becomes of it."""
