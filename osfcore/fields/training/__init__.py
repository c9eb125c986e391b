"""Training of fields from image sets."""
