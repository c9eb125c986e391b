"""Long work in a process of its own: the registry, the worker, and what each kind of job does."""
