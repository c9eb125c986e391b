"""`python -m app.cli`: the same as `osf`."""

from .main import main

if __name__ == "__main__":
    raise SystemExit(main())
