"""How exactly real photographs are understood, measured on synthetic ones whose truth is known."""
