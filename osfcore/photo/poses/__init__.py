"""Poses of objects in photographs: surfels, losses, searches, Gauss-Newton."""
