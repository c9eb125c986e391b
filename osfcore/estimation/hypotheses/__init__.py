"""Pose hypotheses: other orientations, motions, template matches, and scenes assembled from them."""
