"""The commands that write for other programs, and read what they wrote."""
