"""The light of photographs."""
