"""Feature profiles and shape sources by the options that name them."""

from __future__ import annotations

from colmap_affrect.features.dog import detect_dog
from colmap_affrect.features.rootsift import RootSift
from colmap_affrect.features.second_moment import SecondMoment
from colmap_affrect.features.weights import profile_weights
from colmap_affrect.interfaces import Computing, FeatureProfile, ShapeSource
from colmap_affrect.options import (
    FEATURES,
    AffNetHardNetOptions,
    CoverOptions,
    DogOptions,
    ExtractionOptions,
    FeatureOptions,
    SiftOptions,
    entry_points,
)
from colmap_affrect.types import GrayImage, LocalFeatures


def needed_weights(options: ExtractionOptions) -> tuple[str, ...]:
    """Return the keys of the weight files that a recipe reads, sorted."""
    needed = set()
    if isinstance(options.features, AffNetHardNetOptions):
        needed |= set(profile_weights(options.features))
    if "affnet" in shape_sources(options):
        needed.add("affnet")
    return tuple(sorted(needed))


def uses_networks(options: ExtractionOptions) -> bool:
    """Tell whether a recipe runs on torch; a profile of another package may."""
    return (
        bool(needed_weights(options) or options.depth.model)
        or type(options.features) is not SiftOptions
    )


def shape_sources(options: ExtractionOptions) -> set[str]:
    """Return the names of the shape sources that the rectifiers of a recipe read."""
    return {
        rectifier.shape_source
        for rectifier in options.rectifiers
        if isinstance(rectifier, CoverOptions)
    }


def make_profile(options: FeatureOptions, computing: Computing) -> FeatureProfile:
    """Build the feature profile that the options belong to."""
    if isinstance(options, SiftOptions):
        return RootSift(options)
    if isinstance(options, AffNetHardNetOptions):
        from colmap_affrect.features.affnet_hardnet import AffNetHardNet

        return AffNetHardNet(options, computing.weights, computing.device)
    profile: FeatureProfile = entry_points(FEATURES)[options.profile].load()(options, computing)
    return profile


def make_shape_source(name: str, options: ExtractionOptions, computing: Computing) -> ShapeSource:
    """Build the shape source of a name; sparse shapes are those of DoG keypoints."""
    if name == "second-moment":
        return SecondMoment(options.second_moment)
    from colmap_affrect.features.affnet import AffNet
    from colmap_affrect.features.networks import load_affnet

    # Where the profile has another detector, its own thresholds do not apply to DoG.
    dog = options.features if isinstance(options.features, DogOptions) else DogOptions()

    def detect(image: GrayImage) -> LocalFeatures:
        return detect_dog(image, dog, None)

    network = load_affnet(computing.weights["affnet"], computing.device)
    return AffNet(options.affnet, network, detect, computing.device)
