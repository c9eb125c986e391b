"""The robot that a service may drive beside its simulated tables."""
