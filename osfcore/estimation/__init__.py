"""From images to poses and light: paper section 4.2, equations 4 to 6."""
