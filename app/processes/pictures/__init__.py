"""Processes that draw or look at single pictures: thumbnails of objects, photographs of tables."""
