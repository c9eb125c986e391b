"""What pictures are made of besides poses: exposure, ambient light, the table's colour; and models that show the same."""
