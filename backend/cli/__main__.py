"""`python -m backend.cli` is `unglare`."""

from backend.cli import main

if __name__ == "__main__":
    main()
