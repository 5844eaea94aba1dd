"""Published protocols, compared with the packages behind them and with their steps written out in numpy."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from mcdenoise.evaluate import measure
from mcdenoise.metrics import PROTOCOLS, protocols
from mcdenoise.metrics.protocols import ProtocolName

Array = np.ndarray[Any, np.dtype[np.float64]]


def pair(height: int, width: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(torch.linspace(0, 3, height), torch.linspace(0, 5, width), indexing="ij")
    reference = torch.stack([0.6 + 0.6 * torch.sin(x + y), 0.4 + 0.3 * torch.cos(2 * x), 0.3 * y])[None].double()
    noise = 0.1 * torch.randn(reference.shape, generator=generator, dtype=torch.float64)
    return reference + noise, reference


def arrays(*images: Tensor) -> list[Array]:
    return [image[0].permute(1, 2, 0).numpy() for image in images]


def values(protocol: ProtocolName, image: Tensor, reference: Tensor) -> dict[str, float]:
    return measure(PROTOCOLS[protocol].metrics, image, reference)


def legacy_gamma(image: Array) -> Array:
    return np.clip(np.maximum(0, image) ** 0.454545, 0, 1)


def eight_bits(shown: Array) -> Array:
    return np.clip(shown * 255.0 + 0.5, 0, 255).astype(np.uint8) / 255.0


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
    assert found["SSIM"] > metrics.structural_similarity(truth, test, channel_axis=2, data_range=1) + 0.02


def test_meng2020_written_out() -> None:
    image, reference = pair(12, 13)
    test, truth = (eight_bits(legacy_gamma(x)) for x in arrays(image, reference))
    found = values("meng2020", image, reference)
    difference = test - truth
    assert found["RMSE"] == pytest.approx(np.sqrt(np.mean(difference**2)), rel=1e-12)
    assert found["SMAPE"] == pytest.approx(100 * np.mean(2 * np.abs(difference) / (test + truth + 1e-7)), rel=1e-12)
    assert found["relMSE"] == pytest.approx(np.mean(difference**2 / (truth**2 + 1e-7)), rel=1e-12)


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
