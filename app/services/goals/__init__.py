"""Goal images: keeping and composing them, and checking what a photo shows."""
