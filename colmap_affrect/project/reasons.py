"""Why photographs are missing or doubted: codes with values, and the one place that says them."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from colmap_affrect.options import documented

DoubtCode = Literal[
    "few_matches",
    "matches_disagree",
    "little_agreement",
    "no_three_view_points",
    "few_three_view_points",
    "focal_unknown",
    "focal_contradicted",
    "no_parallax",
    "mirrored_copy",
    "focal_spread",
    "tie_points_disagree",
    "tied_by_one_pair",
    "near_others",
    "principal_point_open",
    "camera_shared",
    "cameras_differ",
    "principal_point_contradicted",
    "other_surroundings",
    "two_places",
    "surer_apart",
    "hangs_on",
    "something_moves",
]

SENTENCES: dict[DoubtCode, str] = {
    "few_matches": "few matches support its position",
    "matches_disagree": "most of its matches disagree with this position",
    "little_agreement": "only {percent}% of the matches of its pairs agree with the model",
    "no_three_view_points": "none of its points is seen by two other photographs",
    "few_three_view_points": "only {num} of its points could be found in two other photographs",
    "focal_unknown": "any focal length fits, and the position of the camera depends on that",
    "focal_contradicted": (
        "the given focal length does not fit, {given_px:.0f} px: {fitting_px:.0f} px does"
    ),
    "no_parallax": "a camera that only turned explains {share:.0%} of the matches: no parallax",
    "mirrored_copy": "may be a mirrored copy of {original}",
    "focal_spread": (
        "focal lengths of photographs of its size are up to {ratio:.2f} times apart: some may be "
        "parts of others"
    ),
    "tie_points_disagree": "its tie points disagree",
    "tied_by_one_pair": "with others it hangs on the {num_inliers} inliers of {pair} alone",
    "near_others": (
        "it stands so near to others that the direction between them may be off by "
        "{sigma_deg:.0f} degrees"
    ),
    "principal_point_open": (
        "points do not tell where the optical axes of photographs are: its rotation may be off by "
        "{turn_deg:.0f} degrees"
    ),
    "camera_shared": (
        "photographs of its size are taken for those of one camera: with cameras of their own, "
        "which fit as well, it stands elsewhere, by {turn_deg:.0f} degrees"
    ),
    "cameras_differ": (
        "photographs of its size are taken for those of different cameras: with one camera, which "
        "fits nearly as well, it stands elsewhere, by {turn_deg:.0f} degrees"
    ),
    "principal_point_contradicted": (
        "the given principal point does not fit, and its rotation may be off by {turn_deg:.0f} "
        "degrees"
    ),
    "other_surroundings": (
        "what matches is a part of what it shows, as a poster in two places is: its surroundings, "
        "which the model says are the same, do not match"
    ),
    "two_places": "it alone ties two places, each by another part of it, as a collage does",
    "surer_apart": "what ties it to the model leaves open how both stand to each other",
    "hangs_on": "it hangs on {other}, which is right with a probability of {percent}% itself",
    "something_moves": (
        "something moves as one between photographs, against the rest: {percent}% of what they "
        "show moves as the model says"
    ),
}
"""What to say of each; the numbers in braces are the values of the doubt."""


@documented
@dataclass(frozen=True)
class Doubt:
    """Why the pose of a photograph may be wrong."""

    code: DoubtCode
    """Kind of the reason."""
    values: dict[str, int | float | str] = field(default_factory=dict)
    """Numbers and names that belong to it."""

    def text(self) -> str:
        """Return it in words."""
        return SENTENCES[self.code].format(**self.values)

    def to_mapping(self) -> dict[str, Any]:
        """Return what ``report.json`` has of it."""
        return {"code": self.code, **self.values, "text": self.text()}


def text_of(doubts: Iterable[Doubt]) -> str:
    """Return reasons in words, the main one first."""
    return "; ".join(doubt.text() for doubt in doubts)


def texts_of(doubts: Mapping[str, Iterable[Doubt]]) -> dict[str, str]:
    """Return the reasons of each image in words."""
    return {name: text_of(of_image) for name, of_image in doubts.items()}


def mappings_of(
    doubts: Mapping[str, Iterable[Doubt]],
) -> dict[str, list[dict[str, Any]]]:
    """Return what ``report.json`` has of the reasons of each image."""
    found = dict[str, list[dict[str, Any]]]()
    for name, of_image in doubts.items():
        found[name] = [doubt.to_mapping() for doubt in of_image]
    return found


MissingCode = Literal[
    "another_model",
    "another_group",
    "another_place",
    "left_out",
    "unreadable",
    "no_features",
    "no_verified_pair",
    "not_registered",
    "taken_out",
    "wrong_model",
]

FATES: dict[MissingCode, str] = {
    "another_model": "in another model, sparse/{model}",
    "another_group": "in another model, sparse/{model}, whose photographs match only each other",
    "another_place": "in another model, sparse/{model}: {doubts}",
    "left_out": "left out by hand",
    "unreadable": "unreadable",
    "no_features": "no features",
    "no_verified_pair": "no verified pair",
    "not_registered": "not registered",
    "taken_out": "taken out, {doubts}",
    "wrong_model": "its model was surely wrong: {doubts}",
}
"""What to say of an image that is not in the largest model."""


@documented
@dataclass(frozen=True)
class Missing:
    """Why an image is not in the largest model."""

    code: MissingCode
    """Kind of the reason."""
    model: int = 0
    """Number of the model that it is in, of one of several."""
    partners: dict[str, int] = field(default_factory=dict)
    """Inliers of its best verified pairs, by the other image."""
    doubts: tuple[Doubt, ...] = ()
    """Why it was taken out, if it was."""

    def fate(self) -> str:
        """Return what became of it in a few words."""
        return FATES[self.code].format(model=self.model, doubts=text_of(self.doubts))

    def text(self) -> str:
        """Return all that is known."""
        if not self.partners:
            return self.fate()
        pairs = [f"{other} ({num} inliers)" for other, num in self.partners.items()]
        return f"{self.fate()}; verified with {', '.join(pairs)}"

    def to_mapping(self) -> dict[str, Any]:
        """Return what ``report.json`` has of it."""
        found: dict[str, Any] = {"code": self.code, "text": self.text()}
        if self.model:
            found["model"] = self.model
        if self.partners:
            found["verified_with"] = self.partners
        if self.doubts:
            found["doubts"] = [doubt.to_mapping() for doubt in self.doubts]
        return found


def why_model_was_wrong(missing: Iterable[Missing]) -> str:
    """Return how many images a wrong model had, and the main reason of most of them.

    Args:
        missing: Why images are in no model.

    Returns:
        A few words; none where no model was wrong.
    """
    reasons = Counter[str]()
    for one in missing:
        if one.code == "wrong_model":
            reasons[text_of(one.doubts[:1])] += 1
    if not reasons:
        return ""
    why, _ = reasons.most_common(1)[0]
    return f"that of {reasons.total()} photographs was surely wrong: {why}"
