"""Objects as the service keeps them: adding and deleting one's own, and thumbnails."""
