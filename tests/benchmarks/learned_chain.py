"""Learned features beside kornia's own modules for them, on the same frames. Usage:

    python tests/benchmarks/learned_chain.py --image-path PHOTOS --weights WEIGHTS

Extracts each image by the recipe ``dense-affnet`` and by the same recipe whose features are
described by kornia's ``LAFAffNetShapeEstimator``, ``LAFOrienter`` and ``LAFDescriptor``, view by
view, as the code of the paper does. Prints the seconds of describing and of all but reading,
medians of rounds, their ratios, and how far both are from the descriptors that kornia's modules
give in 64 bits: OriNet's angle is the quotient of two outputs that may both be near zero, so that
rounding alone moves a few descriptors by more than ``TOLERANCE``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
import torch
from kornia import feature
from machine import describe_machine

from colmap_affrect.conventions import MEASUREMENT_SIGMAS
from colmap_affrect.data import GrayImage, LocalFeatures, View
from colmap_affrect.features.affnet_hardnet import AffNetHardNet
from colmap_affrect.features.networks import DESCRIPTOR_NETWORKS
from colmap_affrect.features.weights import load_state_dict
from colmap_affrect.images.photographs import list_images
from colmap_affrect.recipes import load_recipe
from colmap_affrect.report.levels import InspectedLevel, inspect_level
from colmap_affrect.stages.context import Resources
from colmap_affrect.stages.one_image import ImageExtractor, prepare

TOLERANCE = 1e-3


class KorniaChain:
    """The networks as kornia has them; detection as here."""

    def __init__(
        self, ours: AffNetHardNet, extractor: ImageExtractor, dtype: torch.dtype = torch.float32
    ) -> None:
        """Load the weights that the extractor has found; compute in this type."""
        self.ours, self.descriptor_size, self.dtype = ours, ours.descriptor_size, dtype
        weights = extractor.weights
        affnet = feature.LAFAffNetShapeEstimator(pretrained=False, preserve_orientation=False)
        orinet = feature.OriNet(pretrained=False)
        network = DESCRIPTOR_NETWORKS[ours.options.descriptor]()
        parts = {"affnet": affnet, "orinet": orinet, ours.options.descriptor: network}
        for key, part in parts.items():
            part.load_state_dict(load_state_dict(weights[key]), strict=False)
            part.eval().to(dtype)
        self.shape, self.orientation = affnet, feature.LAFOrienter(32, angle_detector=orinet)
        self.descriptor = feature.LAFDescriptor(network, 32, grayscale_descriptor=True)

    def detect(self, view: View) -> LocalFeatures:
        """Detect."""
        return self.ours.detect(view)

    @torch.inference_mode()
    def describe(
        self, images: Sequence[GrayImage], detected: Sequence[LocalFeatures]
    ) -> list[LocalFeatures]:
        """Describe view by view; frames stay those detected."""
        widening = self.ours.options.patch_sigmas / MEASUREMENT_SIGMAS
        described = []
        for image, found in zip(images, detected, strict=True):
            if not len(found):
                described.append(LocalFeatures.empty(self.descriptor_size))
                continue
            pixels = torch.tensor(image / 255, dtype=self.dtype)[None, None]
            lafs = torch.tensor(found.lafs, dtype=self.dtype)[None]
            lafs[..., :2] *= widening
            turned = self.orientation(self.shape(lafs, pixels), pixels)
            rows = torch.nn.functional.normalize(self.descriptor(pixels, turned)[0], dim=1)
            described.append(replace(found, descriptors=rows.numpy()))
        return described


def main() -> None:
    """Print medians and ratios."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--image-path", type=Path, required=True)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--descriptor", default="hardtfeat")
    parser.add_argument("--max-num-images", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    recipe = load_recipe("dense-affnet", [f"features.descriptor={arguments.descriptor}"])
    extractor = prepare(recipe.extraction, Resources(arguments.weights, "cpu"))
    if not isinstance(extractor.extractors[0], AffNetHardNet):
        raise SystemExit("dense-affnet has other features")
    ways = [
        extractor,
        replace(extractor, extractors=(KorniaChain(extractor.extractors[0], extractor),)),
    ]
    exact = replace(
        extractor, extractors=(KorniaChain(extractor.extractors[0], extractor, torch.float64),)
    )
    names = list_images(arguments.image_path)[: arguments.max_num_images]
    print(describe_machine())
    for name in names:
        rounds: list[list[InspectedLevel]] = []
        photograph, _ = extractor.photograph(arguments.image_path / name)
        for _ in range(arguments.rounds):
            rounds.append([inspect_level(way, photograph, 0) for way in ways])
        expected = inspect_level(exact, photograph, 0).features.descriptors
        print(f"{name}: {len(expected)} features; from kornia's in 64 bits")
        for whose, level in zip(("ours", "kornia's in 32"), rounds[-1], strict=True):
            differences = np.abs(level.features.descriptors - expected).max(axis=1)
            print(
                f"{whose} differ by {np.median(differences):.1e}, at most {differences.max():.1e}, "
                f"{np.count_nonzero(differences > TOLERANCE)} by over {TOLERANCE}"
            )
        for what in ("describe", "all steps"):
            steps = [[level.seconds for level in levels] for levels in rounds]
            pairs = [[s.get(what, sum(s.values())) for s in both] for both in steps]
            first, second = (median(column) for column in zip(*pairs, strict=True))
            ratios = sorted(kornia_s / ours_s for ours_s, kornia_s in pairs)
            print(
                f"{what}: ours {first:.1f} s, kornia {second:.1f} s, kornia takes "
                f"{median(ratios):.2f} [{ratios[0]:.2f}-{ratios[-1]:.2f}] times as long"
            )


if __name__ == "__main__":
    main()
