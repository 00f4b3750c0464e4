"""Comparison of methods on one set of photographs."""

DEFAULT_METHODS = (
    "sift-colmap", "sift", "sift-affine-dsp", "unrectified-rootsift", "default", "on-demand",
)  # fmt: skip
"""What is compared where nothing else is asked for."""
LEARNED_METHODS = (
    "aliked-lightglue", "disk-lightglue", "xfeat-lighterglue", "on-demand-learned",
)  # fmt: skip
"""Compared too where their weights are."""
