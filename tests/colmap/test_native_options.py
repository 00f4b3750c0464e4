"""pycolmap's own options by name: every value is converted or refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.native_options import flat_values, resolve, set_values
from colmap_affrect.errors import OptionError

FLAG = "--mapper-options"


def options_of(mapper: str) -> object:
    if mapper == "global":
        return pycolmap.GlobalPipelineOptions()
    return pycolmap.IncrementalPipelineOptions()


@pytest.mark.parametrize(("mapper", "key", "value", "full_key", "resolved"), [
    ("incremental", "mapper.init_max_error", "3", "mapper.init_max_error", 3.0),
    ("incremental", "mapper.num_threads", 4, "mapper.num_threads", 4),
    ("incremental", "ba_refine_principal_point", "True", "ba_refine_principal_point", True),
    ("incremental", "ba_local_backend", "ceres", "ba_local_backend", "CERES"),
    ("incremental", "snapshot_path", Path("a b"), "snapshot_path", "a b"),
    ("global", "max_num_l1_iterations", "7",
     "mapper.rotation_averaging.max_num_l1_iterations", 7),
])  # fmt: skip
def test_option_is_converted_to_pycolmaps_type_and_taken_by_pycolmap(
    mapper: str, key: str, value: object, full_key: str, resolved: object
) -> None:
    found = resolve(options_of(mapper), {key: value}, FLAG)
    assert found == {full_key: resolved}
    assert type(found[full_key]) is type(resolved)
    assert resolve(options_of(mapper), found, FLAG) == found
    native = options_of(mapper)
    set_values(native, found)
    taken = flat_values(native)[full_key]
    if isinstance(resolved, str) and not isinstance(taken, str):
        taken = str(taken) if isinstance(taken, Path) else taken.name
    assert taken == resolved


@pytest.mark.parametrize(("mapper", "key", "value", "message"), [
    ("incremental", "init_max_eror", "3", "did you mean 'init_max_error'"),
    ("global", "gpu_index", "0", "several sections; give mapper.global_positioning.gpu_index"),
    ("incremental", "min_model_size", "2.5", "min_model_size=2.5: expected int"),
    ("incremental", "min_model_size", "9" * 11, ": expected int"),
    ("incremental", "init_max_error", "nan", "=nan: expected float"),
    ("incremental", "multiple_models", "maybe", "expected one of true, false"),
    ("incremental", "ba_local_backend", "GPU", "expected one of CERES, CASPAR"),
    ("global", "gravity_dir", "1", "of type ndarray"),
    ("incremental", "image_path", "x", "it is the one that extract was given"),
    ("global", "mapper.retriangulation.random_seed", "1", "use --random-seed"),
])  # fmt: skip
def test_option_that_pycolmap_does_not_take_is_one_clear_line(
    mapper: str, key: str, value: object, message: str
) -> None:
    with pytest.raises(OptionError) as error:
        resolve(options_of(mapper), {key: value}, FLAG)
    text = str(error.value)
    assert text.startswith(f"{FLAG} {key}")
    assert message in text
    assert "\n" not in text


@pytest.mark.parametrize("key", ["num_threads", "mapper.num_threads"])
def test_threads_that_nobody_has_are_refused(key: str) -> None:
    options = pycolmap.IncrementalPipelineOptions()
    with pytest.raises(OptionError, match="at most 1024, or -1 for all cores"):
        resolve(options, {key: "100000"}, "--mapper-options")
    assert resolve(options, {key: "-1"}, "--mapper-options") == {key: -1}
