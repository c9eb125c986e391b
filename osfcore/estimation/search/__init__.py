"""Optimisers of the losses: CMA-ES, Gauss-Newton, the light search, and where they start."""
