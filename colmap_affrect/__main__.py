"""``python -m colmap_affrect``."""

import sys

from colmap_affrect.cli import main

if __name__ == "__main__":
    sys.exit(main())
