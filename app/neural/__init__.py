"""Neural renderings in a process of their own: what crosses to it, what happens there, and the web process's end."""
