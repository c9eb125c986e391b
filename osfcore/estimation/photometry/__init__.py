"""What pictures are made of besides poses: exposure, ambient light, the table; and models that show the same."""
