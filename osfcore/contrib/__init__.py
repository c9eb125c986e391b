"""What goes beyond the paper, each part alone: files of others, robots, an environment, a client of the service."""
