"""Routes that pages need, more than programs do."""
