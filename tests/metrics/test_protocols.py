"""Published protocols, compared with the packages behind them and with their steps written out in numpy."""

from __future__ import annotations

import math
import sys
from typing import Any, get_args

import numpy as np
import pytest
import torch
from torch import Tensor

from mcdenoise.evaluate import measure
from mcdenoise.metrics import (
    PROTOCOLS,
    UncomputableError,
    aces_displayed,
    gamma_displayed,
    protocols,
    psnr_srgb,
    ssim_srgb,
)
from mcdenoise.metrics.protocols import ProtocolName

Array = np.ndarray[Any, np.dtype[np.float64]]


def pair(height: int, width: int) -> tuple[Tensor, Tensor]:
    """A noisy image with highlights and its smooth reference, ``(1, 3, H, W)``, double precision."""
    generator = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(torch.linspace(0, 3, height), torch.linspace(0, 5, width), indexing="ij")
    reference = torch.stack([0.6 + 0.6 * torch.sin(x + y), 0.4 + 0.3 * torch.cos(2 * x), 0.3 * y])[None].double()
    noise = 0.1 * torch.randn(reference.shape, generator=generator, dtype=torch.float64)
    return reference + noise, reference


def arrays(*images: Tensor) -> list[Array]:
    """``(H, W, 3)``"""
    return [image[0].permute(1, 2, 0).numpy() for image in images]


def values(protocol: ProtocolName, image: Tensor, reference: Tensor) -> dict[str, float]:
    return measure(PROTOCOLS[protocol].metrics, image, reference)


def legacy_gamma(image: Array) -> Array:
    return np.clip(np.maximum(0, image) ** 0.454545, 0, 1)


def eight_bits(shown: Array) -> Array:
    """Values as stored in an 8-bit PNG."""
    return np.clip(shown * 255.0 + 0.5, 0, 255).astype(np.uint8) / 255.0


def test_every_name_is_a_protocol() -> None:
    assert set(PROTOCOLS) == set(get_args(ProtocolName))
    assert all({"PSNR", "SSIM"} <= set(protocol.metrics) for protocol in PROTOCOLS.values())


def test_strict_agrees_with_the_functions() -> None:
    image, reference = pair(31, 40)
    assert values("strict", image, reference) == {
        "PSNR": float(psnr_srgb(image, reference)),
        "SSIM": float(ssim_srgb(image, reference)),
    }


@pytest.mark.parametrize("protocol", ["meng2020", "fan2021"])
def test_psnr_and_ssim_of_old_are_those_of_scikit_image(protocol: ProtocolName) -> None:
    metrics = pytest.importorskip("skimage.metrics")
    image, reference = pair(31, 40)
    rounded = eight_bits if protocol == "meng2020" else lambda shown: shown
    test, truth = (rounded(legacy_gamma(x)) for x in arrays(image, reference))
    found = values(protocol, image, reference)
    assert found["PSNR"] == pytest.approx(metrics.peak_signal_noise_ratio(truth, test, data_range=1), rel=1e-12)
    # The defaults of that function, with the data range that old versions assumed for floats.
    expected = metrics.structural_similarity(truth, test, channel_axis=2, data_range=2)
    assert 0.1 < expected < 0.9
    assert found["SSIM"] == pytest.approx(expected, rel=1e-9)
    # Half of that range would give lower values.
    assert found["SSIM"] > metrics.structural_similarity(truth, test, channel_axis=2, data_range=1) + 0.02


def test_meng2020_written_out() -> None:
    image, reference = pair(12, 13)
    test, truth = (eight_bits(legacy_gamma(x)) for x in arrays(image, reference))
    found = values("meng2020", image, reference)
    difference = test - truth
    assert found["RMSE"] == pytest.approx(np.sqrt(np.mean(difference**2)), rel=1e-12)
    assert found["SMAPE"] == pytest.approx(100 * np.mean(2 * np.abs(difference) / (test + truth + 1e-7)), rel=1e-12)
    assert found["relMSE"] == pytest.approx(np.mean(difference**2 / (truth**2 + 1e-7)), rel=1e-12)


def test_eight_bits_are_rounded_or_truncated() -> None:
    # 0.5^(1/0.454545) is displayed as 0.5, which is 127.5 of 255.
    gray = torch.full((1, 3, 1, 1), 0.5 ** (1 / 0.454545))

    def level(name: ProtocolName, image: Tensor) -> float:
        return float(PROTOCOLS[name].show(image)[0, 0, 0, 0]) * 255

    assert level("meng2020", gray * 1.001) == pytest.approx(128)
    assert level("meng2020", gray * 0.999) == pytest.approx(127)
    assert level("fan2021", gray) == pytest.approx(127.5)
    exact = float(aces_displayed(gray)[0, 0, 0, 0]) * 255
    assert exact % 1 > 0.01
    assert level("noisebase", gray) == pytest.approx(math.floor(exact))


def test_gamma_clamps_after_the_power() -> None:
    shown = gamma_displayed(torch.tensor([-1.0, 0.0, 0.25, 1.0, 9.0]))
    torch.testing.assert_close(shown, torch.tensor([0.0, 0.0, 0.25**0.454545, 1.0, 1.0]))


def written_out_aces(image: Array) -> Array:
    to_curve = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
    back = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
    x = image @ to_curve.T
    x = (x * (x + 0.0245786) - 0.000090537) / (x * (0.983729 * x + 0.4329510) + 0.238081)
    return np.clip(x @ back.T, 0, 1) ** (1 / 2.2)


def test_noisebase_is_that_of_pytorch_msssim() -> None:
    other = pytest.importorskip("pytorch_msssim")
    # Three of the five scales have an odd side.
    image, reference = pair(171, 190)
    tests, truths = (np.floor(written_out_aces(x) * 255) / 255 for x in arrays(image, reference))
    luminances = [torch.from_numpy(x**2.2 @ [0.2126, 0.7152, 0.0722])[None, None] for x in (tests, truths)]
    found = values("noisebase", image, reference)
    expected = float(other.ssim(*luminances, data_range=1.0))
    assert 0.1 < expected < 0.95
    # Its window is in single precision.
    assert found["SSIM"] == pytest.approx(expected, rel=1e-5)
    assert found["MS-SSIM"] == pytest.approx(float(other.ms_ssim(*luminances, data_range=1.0)), rel=1e-5)
    mse = np.mean((tests - truths) ** 2)
    assert found["MSE"] == pytest.approx(mse, rel=1e-9)
    assert found["PSNR"] == pytest.approx(10 * np.log10(1 / mse), rel=1e-9)


def test_noisebase_over_time_written_out() -> None:
    image, reference = pair(12, 13)
    later, truth = pair(12, 13)
    later, truth = later.flip(-1), truth.flip(-1)
    clips = torch.stack([image, later], 1), torch.stack([reference, truth], 1)
    shown = [np.floor(written_out_aces(x) * 255) / 255 for x in arrays(image, later, reference, truth)]
    moved, true = shown[1] - shown[0], shown[3] - shown[2]
    metrics = PROTOCOLS["noisebase"].metrics
    psnr = 10 * np.log10(1 / np.mean((moved - true) ** 2))
    assert float(metrics["tPSNR"].function(*clips)) == pytest.approx(psnr, rel=1e-9)
    rmae = np.mean(np.abs(moved - true) / (np.abs(true) + 0.01)) / 3
    assert float(metrics["tRMAE"].function(*clips)) == pytest.approx(rmae, rel=1e-9)


def test_noisebase_compares_1024_of_1080_rows() -> None:
    reference = torch.full((1, 3, 1080, 12), 0.5)
    psnr = PROTOCOLS["noisebase"].metrics["PSNR"].function
    for row, seen in ((27, False), (28, True), (1051, True), (1052, False)):
        image = reference.clone()
        image[..., row, :] = 0
        assert torch.isfinite(psnr(image, reference)).item() is seen
    # Other sizes are not rendered with a margin.
    image = torch.full((1, 3, 720, 12), 0.5)
    image[..., 0, :] = 0
    assert torch.isfinite(psnr(image, torch.full_like(image, 0.5)))


def test_the_aces_fit_is_made_of_the_color_spaces_of_colour_science(colour: Any) -> None:
    """The matrices contain the conversions to AP1 and back, and the saturations of the ACES transforms."""
    srgb, ap1 = colour.RGB_COLOURSPACES["sRGB"], colour.RGB_COLOURSPACES["ACEScg"]
    luminance = ap1.matrix_RGB_to_XYZ[1]

    def saturation(factor: float) -> Array:
        return factor * np.eye(3) + (1 - factor) * np.tile(luminance, (3, 1))

    into = saturation(0.96) @ colour.matrix_RGB_to_RGB(srgb, ap1, chromatic_adaptation_transform="Bradford")
    out = colour.matrix_RGB_to_RGB(ap1, srgb, chromatic_adaptation_transform="Bradford") @ saturation(0.93)
    np.testing.assert_allclose(protocols._ACES_IN, into, atol=2e-4)
    np.testing.assert_allclose(protocols._ACES_OUT, out, atol=2e-3)
    np.testing.assert_allclose(protocols._REC709_LUMINANCE, srgb.matrix_RGB_to_XYZ[1], atol=1e-4)


@pytest.mark.parametrize(("name", "size"), [("meng2020", (6, 20)), ("noisebase", (10, 20))])
def test_small_images_have_no_ssim(name: ProtocolName, size: tuple[int, int]) -> None:
    image = torch.rand(1, 3, *size)
    with pytest.raises(UncomputableError, match=f"found {size[0]} x {size[1]}"):
        PROTOCOLS[name].metrics["SSIM"].function(image, image)


def test_small_images_have_no_five_scales() -> None:
    image = torch.rand(1, 3, 160, 200)
    with pytest.raises(UncomputableError, match=r"160 x 160 .*160 x 200"):
        PROTOCOLS["noisebase"].metrics["MS-SSIM"].function(image, image)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_images_must_agree(name: ProtocolName) -> None:
    for metric in PROTOCOLS[name].metrics.values():
        with pytest.raises(ValueError, match="reference:"):
            metric.function(torch.rand(1, 3, 20, 20), torch.rand(1, 3, 20, 21))


def test_ms_ssim_without_its_package_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pytorch_msssim", None)
    image = torch.rand(1, 3, 161, 161)
    with pytest.raises(UncomputableError, match=r"pytorch-msssim.*mcdenoise\[peers\]"):
        PROTOCOLS["noisebase"].metrics["MS-SSIM"].function(image, image)
