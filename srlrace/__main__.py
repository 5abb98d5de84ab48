"""``python -m srlrace`` is ``srlrace``."""

from srlrace.cli import main

if __name__ == "__main__":
    main()
