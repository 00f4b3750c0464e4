"""Detection, description and affine shapes."""
