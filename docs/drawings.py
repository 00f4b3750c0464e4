"""Draw the diagrams of docs/pictures: python docs/drawings.py."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

PICTURES = Path(__file__).parent / "pictures"
BLUE, ORANGE, GRAY, INK = "#0b62a8", "#b85c00", "#9aa2ab", "#1b1f24"
STYLE = "font-family='sans-serif' font-size='15'"


def main() -> None:
    """Write all diagrams."""
    write("pixels", 620, 230, pixels())
    write("words", 620, 300, words())
    write("cluster", 620, 220, cluster())
    write("stages", 760, 200, stages())
    write("own-set", 700, 130, chain(OWN_SET))
    write("release", 700, 130, chain(RELEASE))


def write(name: str, width: int, height: int, parts: Sequence[str]) -> None:
    """Write a diagram on white."""
    head = f"<svg xmlns='http://www.w3.org/2000/svg' width='{width}' height='{height}'"
    lines = [f"{head} viewBox='0 0 {width} {height}' {STYLE}>"]
    lines.append(f"<rect width='{width}' height='{height}' fill='white'/>")
    lines += [*parts, "</svg>"]
    path = PICTURES / f"{name}.svg"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def text(
    x: float, y: float, words: str, color: str = INK, anchor: str = "start"
) -> str:
    """Return a line of text that begins, ends or has its middle at x."""
    place = f"x='{x}' y='{y}' fill='{color}' text-anchor='{anchor}'"
    return f"<text {place}>{escape(words)}</text>"


def line(start: tuple[float, float], end: tuple[float, float], color: str = INK) -> str:
    """Return a line."""
    (x1, y1), (x2, y2) = start, end
    ends = f"x1='{x1}' y1='{y1}' x2='{x2}' y2='{y2}'"
    return f"<line {ends} stroke='{color}' stroke-width='2'/>"


def arrow(start: tuple[float, float], end: tuple[float, float]) -> list[str]:
    """Return a level arrow to the right."""
    x, y = end
    tip = f"<path d='M{x - 9} {y - 5} L{x} {y} L{x - 9} {y + 5} z' fill='{INK}'/>"
    return [line(start, (x - 8, y)), tip]


def dot(x: float, y: float, color: str) -> str:
    """Return a dot."""
    return f"<circle cx='{x}' cy='{y}' r='6' fill='{color}'/>"


def box(
    x: float, y: float, size: tuple[float, float], rows: Sequence[str]
) -> list[str]:
    """Return a box with lines of text in its middle."""
    width, height = size
    frame = f"x='{x}' y='{y}' width='{width}' height='{height}' rx='6'"
    parts = [f"<rect {frame} fill='#eef4fa' stroke='{BLUE}' stroke-width='2'/>"]
    top = y + height / 2 - 10 * (len(rows) - 1) + 5
    for number, row in enumerate(rows):
        parts.append(text(x + width / 2, top + 20 * number, row, anchor="middle"))
    return parts


def pixels() -> list[str]:
    """Draw where (0, 0) is, in both conventions."""
    parts = []
    for row in range(2):
        for column in range(3):
            frame = f"x='{60 + 80 * column}' y='{40 + 80 * row}' width='80' height='80'"
            parts.append(f"<rect {frame} fill='none' stroke='{GRAY}'/>")
    parts += [dot(60, 40, ORANGE), dot(100, 80, BLUE)]
    parts.append(text(330, 60, "the corner of the first pixel is (0, 0)", ORANGE))
    parts.append(text(330, 82, "in database.db, models and exports", ORANGE))
    parts.append(text(330, 130, "its centre is (0, 0)", BLUE))
    parts.append(text(330, 152, "in features.h5, OpenCV and hloc", BLUE))
    parts.append(text(330, 195, "the difference is half a pixel", INK))
    return parts


def words() -> list[str]:
    """Draw two cameras that see a point, with the words for what there is."""
    point = (330, 50)
    parts = [dot(*point, ORANGE), text(345, 50, "point, with its track: who sees it")]
    for x, name in ((150, "a.jpg"), (480, "b.jpg")):
        center = (x, 250)
        left = (x - 50, 180)
        right = (x + 50, 180)
        share = (250 - 180) / (250 - point[1])
        seen = (x + share * (point[0] - x), 180)
        parts += [line(center, left, BLUE), line(center, right, BLUE)]
        parts += [line(left, right, BLUE), line(center, point, GRAY)]
        parts += [dot(*seen, BLUE), dot(*center, INK)]
        parts.append(text(x, 280, name, anchor="middle"))
    parts.append(text(10, 175, "photograph"))
    parts.append(text(175, 165, "keypoint", BLUE, "end"))
    parts.append(text(165, 245, "pose: where, and which way"))
    parts.append(text(540, 175, "match:"))
    parts.append(text(540, 195, "both keypoints"))
    parts.append(text(540, 215, "are one point"))
    return parts


def cluster() -> list[str]:
    """Draw the driver, its workers, and the folders that all see."""
    parts = box(20, 70, (160, 70), ("the command", "alone writes"))
    for number in range(3):
        top = 15 + 65 * number
        parts += box(260, top, (140, 45), (f"worker {number + 1}",))
        parts += arrow((180, 105), (260, top + 22))
        parts += arrow((400, top + 22), (470, 105))
    return [*parts, *box(470, 70, (140, 70), ("photographs,", "read by all"))]


STAGES = (
    ("extract", "features"),
    ("pairs", "to match"),
    ("match", "features"),
    ("verify", "and guide"),
    ("map", "models"),
)


def stages() -> list[str]:
    """Draw the chain of stages, and the way back for photographs in need."""
    parts = []
    for number, rows in enumerate(STAGES):
        left = 20 + 150 * number
        parts += box(left, 30, (110, 60), rows)
        if number:
            parts += arrow((left - 40, 60), (left, 60))
    parts += [
        line((675, 90), (675, 150), ORANGE),
        line((675, 150), (375, 150), ORANGE),
        line((375, 150), (375, 100), ORANGE),
        f"<path d='M370 100 L375 91 L380 100 z' fill='{ORANGE}'/>",
        text(
            525,
            172,
            "escalation: photographs in need are matched again",
            ORANGE,
            "middle",
        ),
    ]
    return parts


OWN_SET = (
    ("a model of", "your photographs"),
    ("imc_from_model.py:", "poses, covisibility"),
    ("evaluate imc:", "scores of recipes"),
)
RELEASE = (
    ("version and", "CHANGELOG"),
    ("all tests,", "all benchmarks"),
    ("wheel, tried in", "a new environment"),
)


def chain(steps: Sequence[Sequence[str]]) -> list[str]:
    """Draw boxes in a row, with arrows between them."""
    parts = []
    for number, rows in enumerate(steps):
        left = 20 + 235 * number
        parts += box(left, 30, (180, 70), rows)
        if number:
            parts += arrow((left - 55, 65), (left, 65))
    return parts


if __name__ == "__main__":
    main()
