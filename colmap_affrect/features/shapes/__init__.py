"""Affine shapes of an image."""
