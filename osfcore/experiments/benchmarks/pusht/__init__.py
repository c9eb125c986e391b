"""Planners alone, with true dynamics, on the public benchmark Push-T."""
