"""Compositional rendering of KiloOSFs as published: paper eq. 3 with shadow mapping."""
