"""Comparison of methods on one set of photographs."""

DEFAULT_METHODS = ("sift-colmap", "sift", "rectified", "default")
"""What is compared where nothing else is asked for."""
