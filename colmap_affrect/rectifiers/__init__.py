"""Deciding what to warp: an image in, a rectification plan out."""
