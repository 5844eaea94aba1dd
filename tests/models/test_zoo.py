"""What holds for many methods, each in a row of a table: settings, sizes, states, and frames at the limits."""

from typing import Any

import pytest
import torch
from refusals import refused
from torch import Tensor
from torch.utils import _pytree as pytree
from toys import small, whole_frame

from mcdenoise import Denoiser, create_model

WRONG: dict[str, dict[str, Any]] = {
    "accumulated": {"alpha_min": 0},
    "asvgf": {"alpha": 0.0},
    "bmfr": {"alpha_min": 0.0, "second_alpha": 2.0},
    "cascaded": {"cascade": "K+K+K"},
    "guided": {"radius": 0, "eps": torch.nan},
    "joint_bilateral": {"sigma_color": 0, "sigma_space": torch.inf},
    "kpcn": {"width": 0, "layers": 1, "kernel_size": 4},
    "layered": {"width": 0, "convolutions": 0, "kernel_size": 4},
    "mrkp": {"kernel_size": 2},
    "nbgd": {"layers": 1},
    "nppd": {"width": 0, "backbone": "resnet"},
    "oidn_open": {"quality": "low", "auxiliary": "prefiltered"},
    "oidn": {"quality": "best", "auxiliary": "none", "source": "none", "threads": 0},
    "oidn_temporal": {"auxiliary": "clean", "engine": "none", "prefilter": "none", "history": 0.0},
    "sbmc": {"width": 0, "rounds": 0, "convolutions": 0, "kernel_size": 0},
    "svgf": {"alpha": 0.0},
    "wild": {"alpha_min": 0, "tolerance": -1},
    "wskp": {"layers": 1},
}


@pytest.mark.parametrize(("name", "setting"), [(name, setting) for name, own in WRONG.items() for setting in own])
def test_a_setting_out_of_its_range_is_refused(name: str, setting: str) -> None:
    value = WRONG[name][setting]
    message = refused(lambda: create_model(name, **{setting: value}))
    assert f"{setting}: expected " in message
    assert str(value) in message


# The numbers of weights of the papers or of their public code, and of the default.
SIZES = [
    ("anf", {}, 190_432),
    ("kpcn", {"width": 100, "layers": 9, "kernel_size": 21}, 2 * 2_921_241),
    ("mrkp", {}, 341_838),
    ("nbgd", {"layers": 2}, 7_525),
    ("nbgd", {}, 29_425),
    ("nppd", {"width": 96}, 15_593_341),
    ("nppd", {"width": 128, "backbone": "convunext"}, 33_446_525),
    ("rae", {}, 1_521_529),
    ("wild", {}, 941_825),
]


@pytest.mark.parametrize(("name", "settings", "expected"), SIZES, ids=lambda value: str(value))
def test_the_number_of_weights(name: str, settings: dict[str, Any], expected: int) -> None:
    with torch.device("meta"):
        model = create_model(name, **settings)
    assert sum(each.numel() for each in model.parameters()) == expected


@pytest.mark.parametrize("name", ["accumulated", "anf", "nppd", "rae", "wild_small"])
@torch.no_grad()
def test_a_state_of_zeros_is_that_of_no_frame(name: str) -> None:
    model = small(name)
    first, second = (whole_frame(model, 17, 20, seed=seed) for seed in range(2))
    zeros = pytree.tree_map_only(Tensor, torch.zeros_like, model(first)[1])
    torch.testing.assert_close(model(second, zeros)[0].image, model(second)[0].image)


@pytest.mark.parametrize("name", ["asvgf", "bmfr", "guided", "joint_bilateral", "svgf"])
def test_extremes_stay_finite(name: str) -> None:
    denoiser = Denoiser(name)
    frame = whole_frame(denoiser.model, 40, 36)
    light, depth, normal = frame.color.clone(), torch.full_like(frame.color[:, :1], 1e30), frame.normal
    light[..., ::5, ::7], light[..., ::3, ::4] = 1e16, 0
    depth[..., :4, :], normal[..., :4, :] = torch.inf, 0
    for number, factor in enumerate((1.0, 1e-12, 1.0, 0.0, 1e-30)):
        # Equal noise would be counted once.
        image = denoiser(frame.replace(color=light.roll(number, -1) * factor, depth=depth))
        assert image.isfinite().all()
        assert image.min() >= 0


@pytest.mark.parametrize("name", ["anf", "layered", "nppd", "sbmc"])
def test_a_broken_sample_breaks_nothing(name: str) -> None:
    denoiser = Denoiser(small(name))
    frame = whole_frame(denoiser.model, 9, 8)
    for value in (torch.inf, -1.0, 1e30):
        samples = frame.samples.clone()
        samples[0, 1, 2, 3, 4] = value
        image = denoiser(frame.replace(samples=samples))
        assert image.isfinite().all()
        assert image.min() >= 0
