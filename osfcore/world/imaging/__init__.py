"""Pictures of the simulated tabletop: ray tracing by Embree, and TinyRenderer."""
