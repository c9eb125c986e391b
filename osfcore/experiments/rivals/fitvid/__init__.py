"""FitVid (Babaeizadeh et al., 2021): what a camera will see, predicted pixel by pixel."""
