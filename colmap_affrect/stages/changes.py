"""Inputs that have changed since a run began: what was made from them is forgotten, and made again.

Features hang on photographs, masks and depth maps; matches on the features of two images; pairs,
the database and all that follows on all images, and on cameras that are given.
"""

from collections.abc import Mapping, Sequence

from colmap_affrect.errors import StaleStoreError
from colmap_affrect.project.contents import Contents
from colmap_affrect.project.stores import FeatureStore
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.shown import such_as
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.inputs import Inputs


def refuse_other_photographs(
    workspace: Workspace, image_path: str, digests: Mapping[str, str]
) -> None:
    """Refuse another folder of photographs unless it has some that were worked on."""
    before = (workspace.planned("extract") or {}).get("image_path", image_path)
    if before == image_path:
        return
    known = FeatureStore(workspace.features).contents()
    if known and not any(known.get(name) in ("", digest) for name, digest in digests.items()):
        raise StaleStoreError(
            f"{workspace.path}: the extract stage was run there with image_path={before!r}, and "
            f"none of the photographs in {image_path} is one of them; use --overwrite to discard "
            "the results, or another --output-path"
        )


def forget_changed(
    context: Context,
    inputs: Inputs,
    digests: Mapping[str, str],
    contents: Contents,
    *,
    are_all: bool,
) -> dict[str, str]:
    """Remove what was made from inputs that have changed since, so that it is made again.

    The changed images lose their features last: a run that is killed before finds them changed
    again. ``digests`` are of the content of each image now; ``contents`` are brought up to date;
    ``are_all`` says that there are no other images. Returns one line by the folder of the
    photographs, empty if nothing has changed. StaleStoreError for results in a user's database.
    """
    workspace, store = context.workspace, context.features
    known = store.contents()
    changed = [name for name in digests if known.get(name, "") not in ("", digests[name])]
    are_all = are_all and not workspace.users_database
    gone = sorted(known.keys() - digests.keys()) if are_all else []
    cameras, before = contents.digest(inputs.camera_files), contents.recorded("cameras")
    other_cameras = ["cameras are given by other files"] if before not in ("", cameras) else []
    lines = [*_counted(changed, "changed"), *_counted(gone, "gone"), *other_cameras]
    if lines:
        workspace.rewind(f"since it was made, {', '.join(lines)}")
        workspace.pairs.unlink(missing_ok=True)
        context.matches.remove({*changed, *gone})
        if changed or gone:
            store.remove({*changed, *gone})
    if unknown := {n: digests[n] for n in known.keys() & digests.keys() if not known[n]}:
        store.record_contents(unknown)
    contents.record("cameras", cameras)
    if not lines:
        return {}
    return {inputs.image_path: f"{', '.join(lines)}; all that hangs on them is made again"}


def _counted(names: Sequence[str], what: str) -> list[str]:
    return [f"{len(names)} {what} ({such_as(names)})"] if names else []


def refuse_changed(context: Context, digests: Mapping[str, str]) -> None:
    """Refuse to add to the features of photographs that have changed; StaleStoreError."""
    known = context.features.contents()
    changed = _counted([n for n in digests if known.get(n, "") not in ("", digests[n])], "changed")
    if changed:
        raise StaleStoreError(
            f"{context.workspace.features}: {changed[0]} since their features were extracted; run "
            "extract again"
        )
