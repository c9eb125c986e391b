"""Commands on finished episodes: clips, stories."""
