"""``python -m colmap_affrect``."""

from colmap_affrect.cli import main_of_process

if __name__ == "__main__":
    main_of_process()
