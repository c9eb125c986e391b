"""Robots over the wire as worlds, and what stands between a plan and a motor: limits, a stop, a question before."""
