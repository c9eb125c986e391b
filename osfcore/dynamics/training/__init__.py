"""Training of the propagation network on recorded pushes."""
