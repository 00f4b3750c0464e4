"""Every feature profile keeps the contract, with every detector; networks have random weights."""

from __future__ import annotations

from pathlib import Path

import pytest
from contracts.profile_contract import ProfileContract
from random_weights import write_random_weights

from colmap_affrect.features.affnet_hardnet import AffNetHardNet
from colmap_affrect.features.rootsift import RootSift
from colmap_affrect.interfaces import FeatureProfile
from colmap_affrect.options import DETECTORS, FEATURE_OPTIONS, AffNetHardNetOptions, SiftOptions


def test_every_registered_profile_is_here() -> None:
    tested = {
        cls.__name__ for cls in (*ProfileContract.__subclasses__(), *_Learned.__subclasses__())
    }
    assert set(FEATURE_OPTIONS) == {"rootsift", "affnet-hardnet"}
    assert tested >= {"TestRootSift", *(f"TestAffNetHardNet{name.title()}" for name in DETECTORS)}


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_random_weights(tmp_path_factory.mktemp("weights"))


class TestRootSift(ProfileContract):
    def make(self) -> FeatureProfile:
        return RootSift(SiftOptions())


class _Learned(ProfileContract):
    detector = ""

    @pytest.fixture(autouse=True)
    def _weights(self, weights: dict[str, Path]) -> None:
        self.weights = weights

    def make(self) -> FeatureProfile:
        options = AffNetHardNetOptions(
            detector=self.detector, descriptor="tfeat", max_num_features=60
        )
        return AffNetHardNet(options, self.weights, "cpu")


class TestAffNetHardNetDog(_Learned):
    detector = "dog"


class TestAffNetHardNetKeynet(_Learned):
    detector = "keynet"


class TestAffNetHardNetHessian(_Learned):
    detector = "hessian"
