"""Inputs that have changed since a run began: what was made from them is forgotten, and made again.

Features hang on photographs, masks and depth maps; matches on the features of two images; pairs,
the database and all that follows on all images, and on cameras that are given.
"""

from collections.abc import Iterable, Mapping, Sequence

from colmap_affrect.errors import StaleStoreError
from colmap_affrect.project.contents import Content, content_of
from colmap_affrect.project.stores import FeatureStore
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import ExtractionOptions
from colmap_affrect.shown import such_as
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.inputs import Inputs


def refuse_other_photographs(
    workspace: Workspace, image_path: str, contents: Mapping[str, Content]
) -> None:
    """Refuse another folder of photographs unless it has some that were worked on."""
    before = (workspace.planned("extract") or {}).get("image_path", image_path)
    if before == image_path:
        return
    known = FeatureStore(workspace.features).contents()
    if known and len(changed_images(known, contents)) == len(known.keys() & contents.keys()):
        raise StaleStoreError(
            f"{workspace.path}: the extract stage was run there with image_path={before!r}, and "
            f"none of the photographs in {image_path} is one of them; use --overwrite to discard "
            "the results, or another --output-path"
        )


def contents_of(
    inputs: Inputs,
    names: Iterable[str],
    options: ExtractionOptions,
    known: Mapping[str, Content],
) -> dict[str, Content]:
    """Return what the files of images hold now; ``known`` ones are read only if they changed."""
    return {name: content_of(inputs.files(name, options), known.get(name)) for name in names}


def changed_images(known: Mapping[str, Content], now: Mapping[str, Content]) -> list[str]:
    """Return the images whose files are not those any more that their features are from."""
    both = [name for name in now if name in known and known[name].digest]
    return [name for name in both if known[name].digest != now[name].digest]


def forget_changed(
    context: Context, inputs: Inputs, contents: Mapping[str, Content], *, are_all: bool
) -> dict[str, str]:
    """Remove what was made from inputs that have changed since, so that it is made again.

    The changed images lose their features last: a run that is killed before finds them changed
    again. ``contents`` are those of each image now; ``are_all`` says that there are no other
    images. Returns one line by the folder of the photographs, empty if nothing has changed.
    StaleStoreError for results in a user's database.
    """
    workspace, store = context.workspace, context.features
    known = store.contents()
    changed = changed_images(known, contents)
    are_all = are_all and not workspace.users_database
    gone = sorted(known.keys() - contents.keys()) if are_all else []
    cameras, before = content_of(inputs.camera_files).digest, workspace.made_from("cameras")
    other_cameras = ["cameras are given by other files"] if before not in ("", cameras) else []
    lines = [*_counted(changed, "changed"), *_counted(gone, "gone"), *other_cameras]
    if lines:
        workspace.rewind(f"since it was made, {', '.join(lines)}")
        workspace.pairs.unlink(missing_ok=True)
        context.matches.remove({*changed, *gone})
        if changed or gone:
            store.remove({*changed, *gone})
    left = known.keys() & contents.keys() - set(changed)
    if other := {name: contents[name] for name in left if known[name] != contents[name]}:
        store.record_contents(other)
    workspace.record_made_from("cameras", cameras)
    if not lines:
        return {}
    return {inputs.image_path: f"{', '.join(lines)}; all that hangs on them is made again"}


def _counted(names: Sequence[str], what: str) -> list[str]:
    return [f"{len(names)} {what} ({such_as(names)})"] if names else []


def refuse_changed(context: Context, inputs: Inputs, names: Iterable[str]) -> None:
    """Refuse to add to the features of photographs that have changed; StaleStoreError."""
    known = context.features.contents()
    now = contents_of(inputs, names, context.extraction, known)
    if changed := _counted(changed_images(known, now), "changed"):
        raise StaleStoreError(
            f"{context.workspace.features}: {changed[0]} since their features were extracted; run "
            "extract again"
        )
