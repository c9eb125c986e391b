"""`python -m app.cli`: the same as `osf`."""

from app.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
