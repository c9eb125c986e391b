"""Neural fields: image sets to learn from, how objects and the table scatter light, and their training."""
