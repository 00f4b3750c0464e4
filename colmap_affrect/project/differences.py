"""Options on record: what of them counts when they are compared with those given now."""

from collections.abc import Mapping
from typing import Any

from colmap_affrect.options import flat

LOCAL = ("image_path", "image_list_path", "from_database", "cameras")  # not in digests of options
PLACES = {
    "image_path", "image_list_path", "from_database", "cameras.cameras_path", "masks.path",
    "masks.camera_path", "depth.path", "match_list_path", "database",
}  # fmt: skip
"""Options that say where files are: other places are no other options, what the files hold counts
(:mod:`colmap_affrect.project.contents`). But none at all is another option."""
GIVEN = "given"  # what stands in the place of such an option when options are compared
WEIGHTS = "weights"  # of a record: the digests of files, beside the options of a stage


def placeless(options: Mapping[str, Any], there: str = "", prefix: str = "") -> dict[str, Any]:
    """Return options without places of files; ``there`` stands where one is given."""
    found = dict(options)
    for key, value in options.items():
        if isinstance(value, Mapping):
            found[key] = placeless(value, there, f"{prefix}{key}.")
        elif value and prefix + key in PLACES:
            found[key] = there
    return found


def without_digests(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is on record for a stage without the digests of weights, which nobody gives."""
    return {key: value for key, value in options.items() if key != WEIGHTS}


def first_difference(known: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Say where options on record differ from those given now; empty if they do not."""
    old, new = flat(known), flat(now)
    # The name of a part first: with another one most other options differ too.
    keys = sorted(old.keys() | new.keys(), key=lambda key: (key.rpartition(".")[2] != "name", key))
    for key in keys:
        if old.get(key) != new.get(key):
            return f"{key}={old.get(key)!r}, and it is {new.get(key)!r} now"
    return ""
