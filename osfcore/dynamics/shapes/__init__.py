"""Shapes of objects as dynamics needs them, read off their fields."""
