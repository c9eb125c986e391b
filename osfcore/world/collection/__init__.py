"""Data collected from the simulated tabletop: image sets, observations, pushes."""
