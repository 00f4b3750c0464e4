"""Photographs: which there are, reading, masks, warping, depth maps."""
