"""What attacks on the program found, the review of data and robustness: what happens now.

Each row: what was done, what happens now, and the tests, or the doctest, that show it.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
CHANGED = "robustness/test_changed_inputs.py"
HOSTILE = "robustness/test_hostile_databases.py"
DOUBTS = "mappers/test_doubts.py"
EQUALS = f"{CHANGED}::test_run_after_a_change_equals_a_fresh_one"

ROWS: list[tuple[str, str, tuple[str, ...]]] = [
    # Stale data
    (
        "photograph rotated, replaced or edited, run again",
        "its digest is another one: it is extracted again with its matches and all that follows, "
        "and one line says so; the results equal a fresh run's",
        (EQUALS, f"{CHANGED}::test_climbing_refuses_photographs_that_have_changed"),
    ),
    (
        "the same in a database of the user's own, by functions with pycolmap's names",
        "argued: refused in a line that names the photographs and says to begin a new database. "
        "It is the user's, may hold what other programs made of the same features, and these "
        "functions, like pycolmap's, only add to it",
        (f"{CHANGED}::test_changed_photograph_of_a_users_database_is_named",),
    ),
    (
        "the same behind another program's database, by map --from-database",
        "argued: it does not say what its features were extracted from, so only another size of a "
        "photograph can be told, in a line; a database that was damaged since discards no model",
        (f"{CHANGED}::test_photograph_of_another_size_than_its_camera_is_told_by_map",),
    ),
    (
        "photograph deleted or renamed",
        "it leaves features, pairs, model and count, with a line",
        (
            EQUALS,
            f"{CHANGED}::test_photographs_that_moved_or_are_gone_are_named_by_map",
        ),
    ),
    ("mask painted over, depth map changed", "as photographs", (EQUALS,)),
    (
        "photograph folder moved",
        "no change if the contents agree; another folder with none of the photographs is refused",
        (EQUALS, f"{CHANGED}::test_other_folder_with_none_of_the_photographs_is_refused"),
    ),
    (
        "output folder inside the photograph folder",
        "folders of this program are never input; inspect refuses to draw beside the photographs",
        (EQUALS,),
    ),
    (
        "--from-database: extra photographs in the folder",
        "a line says how many are left out",
        (f"{CHANGED}::test_photographs_that_a_database_does_not_name_are_told",),
    ),
    # Wrong models called success
    (
        "mirrored copies, crops, pure rotation, repeated tiles, portraits with 31 points",
        "models are judged for run, map and compare alike; doubts are in summary, report and exit "
        "code, with what to try",
        (
            f"{DOUBTS}::test_mirrored_copies_that_the_others_support_alike",
            f"{DOUBTS}::test_mirrored_copy_leaves_and_the_photograph_stays",
            f"{DOUBTS}::test_camera_that_only_turned",
            f"{DOUBTS}::test_images_that_few_points_hold",
            f"{DOUBTS}::test_two_of_more_photographs_are_no_model",
        ),
    ),
    # Process ends, tracebacks
    (
        "one random page of the source of --from-database damaged",
        "quick_check on the file before COLMAP sees it: one line",
        (f"{HOSTILE}::test_damaged_pages_are_one_line",),
    ),
    (
        "camera_id=999, rows=100000, rows=-1, short blobs, camera model 12345, NaN parameters, "
        "width 2^63, keypoints at 1e30, half a pose of a pair, names that are not UTF-8",
        "one line that names the rows; doctor reports the same as errors",
        (
            f"{HOSTILE}::test_hostile_rows_are_one_line",
            "colmap/test_checks.py::test_what_is_broken_is_found_and_nothing_else",
        ),
    ),
    (
        "rollback journal beside the source",
        "a hot one is refused with advice, one that is over does not matter",
        (
            f"{HOSTILE}::test_hot_journal_is_refused_with_advice",
            f"{HOSTILE}::test_journal_that_is_over_does_not_matter",
        ),
    ),
    (
        "file names that are not UTF-8",
        "left out with a line before any work is done",
        (
            "robustness/test_security.py::"
            "test_any_name_of_a_file_comes_through_or_is_left_out_with_a_line",
            "robustness/test_security.py::test_folder_whose_name_is_not_utf8_is_one_line",
        ),
    ),
    (
        "empty or truncated journal of an HDF5 file",
        "length and checksum tell; the last good state is used",
        ("project/test_atomic_files.py::test_journal_that_is_torn_or_damaged_is_left_out",),
    ),
    (
        "EQUIRECTANGULAR cameras, as an option and in a database",
        "refused in one line before anything is recorded",
        (
            "robustness/test_bad_input.py::"
            "test_cameras_that_cannot_be_used_are_refused_before_anything_is_recorded",
            f"{HOSTILE}::test_panoramas_are_refused_before_anything_is_recorded",
        ),
    ),
    (
        "unknown existing_camera_id",
        "one line, and the corrected call works",
        (
            "robustness/test_bad_input.py::"
            "test_cameras_that_cannot_be_used_are_refused_before_anything_is_recorded",
        ),
    ),
    (
        "--scheduler at a port that is not Dask's, or where nothing listens",
        "one line within 11 s",
        (
            "parallel/test_cluster.py::test_port_of_another_program_is_refused_in_one_line",
            "parallel/test_cluster.py::test_cluster_that_is_no_use_is_refused_in_one_line",
        ),
    ),
    (
        "recipes, lists and tables with a BOM",
        "read; text models of COLMAP that pycolmap reads (ground truth, --extend) are refused in "
        "one line, since COLMAP itself does not take them",
        ("robustness/test_bad_input.py::test_files_of_text_may_begin_with_a_byte_order_mark",),
    ),
    (
        "Ctrl-C while Python deletes an object",
        "repeated, so that the command ends with 130 and no traceback",
        ("cli/test_processes.py::test_interrupt_that_python_cannot_raise_is_repeated",),
    ),
    # Escapes, files, resources
    (
        "terminal escapes and U+202E in names",
        "one filter for all that is shown",
        (
            "robustness/test_security.py::test_message_cannot_steer_the_terminal",
            "robustness/test_security.py::"
            "test_any_name_of_a_file_comes_through_or_is_left_out_with_a_line",
        ),
    ),
    (
        "CSV cells beginning with = + - @",
        "a quote before them",
        ("../colmap_affrect/project/report.py::_no_formula",),
    ),
    (
        "*.new, *.partial overwritten, also through symlinks",
        "files of ours have random names and are made with O_EXCL; copies of databases and "
        "exports keep their names, which are unlinked first: a link there is removed, not followed",
        (
            "project/test_atomic_files.py::test_links_that_lie_in_the_way_are_not_followed",
            "robustness/test_security.py::test_nothing_is_written_outside_the_output_folder",
        ),
    ),
    (
        "import-h5 killed",
        "the next import removes what was left, unless its process lives",
        (
            "project/test_workspace.py::"
            "test_temporary_folders_of_killed_processes_are_removed_and_no_others",
        ),
    ),
    (
        "depth maps and masks far larger than the photograph, data in other files",
        "refused by the header: masks have the photograph's size, maps four values for each pixel",
        (
            "images/test_photographs.py::"
            "test_image_with_a_wrong_mask_is_reported_and_the_others_go_on",
            "images/test_depth.py::test_map_far_larger_than_the_photograph_is_refused_by_its_header",
            "images/test_depth.py::test_values_in_other_files_are_not_read",
            "robustness/test_fuzz.py::test_header_of_a_huge_map_takes_no_memory",
        ),
    ),
    (
        "32000 x 32000 PNG of 1 MB",
        "left out by its header with a line, also by COLMAP's SIFT in compare; 512 megapixels are "
        "read",
        (
            "images/test_reading.py::test_photograph_of_absurd_size_is_refused_by_its_header",
            "comparison/test_methods.py::"
            "test_sift_passes_over_photographs_and_masks_of_absurd_size",
        ),
    ),
    (
        "TIFF with an EXIF orientation (found beside the review: turned by OpenCV, not by COLMAP)",
        "read as stored, like all other formats",
        ("images/test_reading.py::test_header_and_pixels_are_those_that_are_stored",),
    ),
    (
        "5,000 images: repeating a finished extract, or run",
        "features.h5 is gone through once, and not at all while its index fits; no header, no pair "
        "is looked at and the page stays: about 3 s of processor time for run",
        (
            "project/test_feature_index.py::"
            "test_another_process_reads_the_index_and_none_that_is_stale_or_damaged",
            "stages/test_stages.py::test_idle_run_looks_at_no_header_and_leaves_the_page",
        ),
    ),
    (
        "5,000 images: all pairs as a list",
        "written without keeping it; pairs, match and verify have it as numbers of images. Left: "
        "on-demand recipes look at all pairs as names, since which climb depends on all others; "
        "twelve million pairs take days to match, and a warning names --pairs retrieval",
        (
            "pairs/test_lists.py::test_all_pairs_of_thousands_are_written_without_keeping_them",
            "pairs/test_lists.py::test_all_pairs_of_thousands_are_read_and_ordered_as_numbers",
        ),
    ),
    (
        "kills at random moments and single system calls, full disks, damaged pages and databases",
        "all resumed to identical results or refused in one line: test_campaign.py here, and "
        "tests/benchmarks/campaign.py. A "
        "kill between two changes of the matches, which lost climbed pairs, is a test of its own",
        (
            "stages/test_escalate.py::"
            "test_run_killed_between_two_changes_of_its_matches_goes_on_to_the_same_result",
            "stages/test_stationary.py::"
            "test_matches_that_a_killed_run_did_not_look_at_are_looked_at_by_the_next",
            "colmap/test_database.py::test_database_that_cannot_be_made_on_a_full_disk_says_so",
        ),
    ),
    (
        "max_image_size_px=4000 takes 5.2 GiB",
        "as many images at once as half of the memory holds; what 12 megapixels take is tested. "
        "The README says what memory the option costs",
        ("robustness/test_images.py::test_hundred_megapixels_fit_into_little_memory",),
    ),
]


@pytest.mark.parametrize(
    "where", sorted({where for *_, tests in ROWS for where in tests}), ids=lambda where: where
)
def test_tests_of_the_table_are_there(where: str) -> None:
    file, _, name = where.partition("::")
    source = (TESTS / file).read_text(encoding="utf-8")
    assert re.search(rf"^def {name}[(]", source, re.MULTILINE)
