"""Versions of what a result depends on."""

import platform
from importlib import metadata

REPORTED_PACKAGES = (
    "colmap-affrect", "pycolmap", "pyceres", "opencv-python-headless", "numpy", "h5py", "torch",
    "kornia",
)  # fmt: skip


def installed_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that decide results."""
    versions = {"python": platform.python_version()}
    for package in REPORTED_PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed as a package"
    return versions
