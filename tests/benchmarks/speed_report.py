"""Markdown tables of what the speed benchmark has measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from statistics import median
from typing import Any

from machine import Peaks
from speed_growth import growth_exponent
from speed_stages import IMAGE_STAGES, PAIR_STAGES
from stage_clock import Work

Row = Mapping[str, float]
Results = Mapping[str, Any]


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a table, its first column aligned left."""
    lines = [header, ["---", *["--:"] * (len(header) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def with_ratio(values: Sequence[float], references: Sequence[float]) -> str:
    """Format the median of values by round, and median and range of the ratios by round."""
    ratios = [mine / other for mine, other in zip(values, references, strict=True)]
    spread = f"{median(ratios):.2f} [{min(ratios):.2f}-{max(ratios):.2f}]"
    return f"{median(values):.3g} s, {spread}"


def commands_table(results: Mapping[str, Sequence[Row]]) -> str:
    """Compare the whole commands; the first method is the reference of the ratios."""
    reference = next(iter(results.values()))
    header = (
        "method", "extract an image", "match a pair", "verify a pair", "map",
        "features per image", "features per s", "inliers per pair", "peak memory",
    )  # fmt: skip
    rows = []
    for name, rounds in results.items():

        def seconds(key: str, unit: str, rounds: Sequence[Row] = rounds) -> str:
            return with_ratio(_each(rounds, key, unit), _each(reference, key, unit))

        speed = median(row["features"] / row["extract_s"] for row in rounds)
        rows.append(
            (
                name,
                seconds("extract_s", "images"),
                seconds("match_s", "pairs"),
                seconds("verify_s", "pairs"),
                f"{median(row['map_s'] for row in rounds):.3g} s",
                f"{median(_each(rounds, 'features', 'images')):.0f}",
                f"{speed:.0f}",
                f"{median(_each(rounds, 'inliers', 'pairs')):.0f}",
                _mebibytes([row["peak_mib"] for row in rounds if "peak_mib" in row]),
            )
        )
    first = reference[0]
    return (
        f"Whole commands on all cores: {first['images']:.0f} images, {first['pairs']:.0f} pairs, "
        f"{len(reference)} rounds in turn. Median, then median [range] of the ratio to "
        f"{next(iter(results))} in the same round. Peak memory is above what the process "
        "held before.\n\n" + table(header, rows)
    )


def _each(rounds: Sequence[Row], key: str, unit: str) -> list[float]:
    return [row[key] / row[unit] for row in rounds]


def _mebibytes(values: Sequence[float]) -> str:
    return f"{max(values):.0f} MiB" if values else "-"


def stages_tables(results: Mapping[str, Mapping[str, Any]], peaks: Peaks) -> str:
    """Show where the time of each method goes, and how far each stage is from its limit."""
    parts = [
        "Core seconds of the stages, and their counted work at the peak of a core: "
        f"{peaks.gflops_one:.0f} GFLOP/s float32, {peaks.gbytes_one:.1f} GB/s (all cores: "
        f"{peaks.gflops_all:.0f}, {peaks.gbytes_all:.1f}). Per image, match and verify per pair; "
        "median [range] over rounds.\n"
    ]
    header = ("stage", "core seconds", "share", "G multiply-adds", "limit (s)", "times the limit")
    for name, result in results.items():
        by_stage = {
            stage: [seconds[stage] for seconds in result["seconds"]]
            for stage in (*IMAGE_STAGES, *PAIR_STAGES)
            if stage in result["seconds"][0]
        }
        total = sum(median(values) for stage, values in by_stage.items() if stage in IMAGE_STAGES)
        rows = []
        for stage, values in by_stage.items():
            share = f"{100 * median(values) / total:.0f} %" if stage in IMAGE_STAGES else ""
            work = Work(*result["work"].get(stage, (0.0, 0.0)))
            rows.append((stage, _spread(values), share, *_against_limit(values, work, peaks)))
        rows.insert(
            sum(stage in IMAGE_STAGES for stage in by_stage),
            ("**an image**", f"**{total:.3g}**", "100 %", "", "", ""),
        )
        parts.append(f"**{name}**\n\n" + table(header, rows))
    return "\n".join(parts)


def _against_limit(seconds: Sequence[float], work: Work, peaks: Peaks) -> tuple[str, str, str]:
    limit_s = peaks.limit_s(work)
    if not limit_s:
        return "", "", ""
    return f"{work.multiply_adds / 1e9:.3f}", f"{limit_s:.4f}", f"{median(seconds) / limit_s:.1f}"


def _spread(values: Sequence[float]) -> str:
    return f"{median(values):.3f} [{min(values):.3f}-{max(values):.3f}]"


def growth_table(
    results: Mapping[str, Sequence[Sequence[float]]],
    size_name: str,
    format_size: Callable[[float], str],
    title: str,
) -> str:
    """Show seconds by size and the exponent of growth; each cell may have its own size.

    Args:
        results: for each method (size, seconds).
        size_name: heading of the first column.
        format_size: text of a size.
        title: what was measured.
    """
    curves = list(results.values())
    rows = [
        (format_size(points[0][0]), *(f"{point[1]:.3g} s" for point in points))
        for points in zip(*curves, strict=True)
    ]
    rows.append(("exponent", *(f"{growth_exponent(curve):.2f}" for curve in curves)))
    return f"{title}\n\n" + table((size_name, *results), rows)


def images_table(results: Mapping[str, Sequence[Row]]) -> str:
    """Show what whole commands cost on more and more images, and the growth of mapping."""
    header = (
        "method", "images", "pairs", "extract an image", "match a pair", "verify a pair", "map",
        "registered", "peak memory", "features.h5", "matches.h5", "database.db",
    )  # fmt: skip
    rows = [
        (
            name,
            f"{row['images']:.0f}",
            f"{row['pairs']:.0f}",
            f"{row['extract_s'] / row['images']:.3g} s",
            f"{row['match_s'] / row['pairs']:.3g} s",
            f"{row['verify_s'] / row['pairs']:.3g} s",
            f"{row['map_s']:.3g} s",
            f"{row['registered']:.0f}",
            _mebibytes([row["peak_mib"]] if "peak_mib" in row else []),
            *(
                f"{row[key] / 2**20:.1f} MiB" if row[key] else "-"
                for key in ("features_bytes", "matches_bytes", "database_bytes")
            ),
        )
        for name, counts in results.items()
        for row in counts
    ]
    exponents = [
        f"{name} {growth_exponent([(row['images'], row['map_s']) for row in counts]):.2f}"
        for name, counts in results.items()
        if len(counts) > 1
    ]
    return (
        "Whole commands by number of images, all pairs, one run each.\n\n"
        + table(header, rows)
        + (f"\nMapping grows with images to the power of: {', '.join(exponents)}.\n")
    )


def report(results: Results) -> str:
    """Format all sections that there are results of."""
    parts = [results["machine"] + "\n"]
    if "commands" in results:
        parts.append(commands_table(results["commands"]))
    if "stages" in results:
        parts.append(stages_tables(results["stages"], Peaks(**results["peaks"])))
    if "pixels" in results:
        title = (
            "Core seconds of extraction of one picture by its size, without reading and writing."
        )
        parts.append(growth_table(results["pixels"], "Mpx", lambda px: f"{px / 1e6:.2f}", title))
    if "features" in results:
        title = "Core seconds of matching a pair, the same RootSIFT features for both."
        parts.append(growth_table(results["features"], "features", lambda n: f"{n:.0f}", title))
    if "images" in results:
        parts.append(images_table(results["images"]))
    return "\n".join(parts)
