"""COLMAP through pycolmap, imported here and nowhere else."""

from colmap_affrect.project.atomic_files import uninterrupted

with uninterrupted():  # pycolmap takes Ctrl-C in its import for a broken installation
    import pycolmap

__all__ = ["pycolmap"]
