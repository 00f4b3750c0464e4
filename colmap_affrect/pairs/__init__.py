"""Which images are matched."""
