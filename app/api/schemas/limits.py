"""What REST allows, in one place; bounds of the core are taken from there.

The page writes them down again, in static/index.html and static/js; a test compares.
"""

Bounds = tuple[int, int]

# Lists
MAX_PAGE = 500
