"""Pure geometry on numpy arrays: affine maps, the space of tilts, canvases of warps."""
