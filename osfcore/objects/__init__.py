"""Which objects exist: catalogue, mesh sources, conversion, the library on disk."""
