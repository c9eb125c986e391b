"""Rollouts compiled for the CPU: the graph, the features and the network of the modules above, scene by scene."""
