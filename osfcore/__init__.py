"""Object-centric neural scattering functions for multi-object manipulation: the core, free of user interfaces."""
