"""Which images to match, and matching."""
