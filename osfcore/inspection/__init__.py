"""Checks of files that people bring, and pictures of how they were understood."""
