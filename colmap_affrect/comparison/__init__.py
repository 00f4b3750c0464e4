"""Comparison of methods on one set of photographs."""

DEFAULT_METHODS = ("sift", "sift-affine-dsp", "unrectified-rootsift", "default", "on-demand")
"""What is compared where nothing else is asked for."""
