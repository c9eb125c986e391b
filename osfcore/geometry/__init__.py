"""Poses, rotations, cameras, light, scene states, convex parts: the vocabulary of all other packages."""
