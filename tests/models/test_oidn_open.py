"""Open Image Denoise's network in torch: the library's own results, its equations, and archives of weights."""

import itertools
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from refusals import refused
from toys import frame_of, has_oidn

from mcdenoise import Denoiser, Frame
from mcdenoise.models import create_model
from mcdenoise.models._tza import archives_in, read_tza
from mcdenoise.models.oidn import Oidn
from mcdenoise.models.oidn_open import OpenFilters
from mcdenoise.nn.oidn import OidnUNet, oidn_exposure
from mcdenoise.ops._constants import MAX_RADIANCE
from mcdenoise.ops._steps.transfer import compress, expand

NAME = "oidn_open"


def lit(height: int = 45, width: int = 70, seed: int = 0) -> Frame:
    """Radiance over five decades, an albedo, and normals of any length up to one."""
    draws = torch.Generator().manual_seed(seed)
    color = torch.exp(4 * torch.randn(1, 3, height, width, generator=draws))
    albedo = torch.rand(1, 3, height, width, generator=draws)
    normal = 2 * torch.rand(1, 3, height, width, generator=draws) - 1
    return Frame(color=color, albedo=albedo, normal=normal)


def without_border(model: Any) -> Any:
    """The library takes what is around an image as black."""
    model.border = 0
    return model


@has_oidn
@pytest.mark.parametrize("quality", ["fast", "balanced", "high"])
@pytest.mark.parametrize("auxiliary", ["noisy", "clean"])
def test_equals_the_result_of_the_library(quality: Any, auxiliary: Any) -> None:
    frame = lit()
    model = without_border(create_model(NAME, quality=quality, auxiliary=auxiliary))
    with torch.no_grad():
        image = model(frame)[0].image
    expected = Oidn(quality, auxiliary, threads=1)(frame)[0].image
    # They agree on the network's scale, where rounding is even: some twenty layers in float32 sum in another order.
    exposure = oidn_exposure(frame.color)
    torch.testing.assert_close(compress(image * exposure), compress(expected * exposure), rtol=0, atol=20 * 2.0**-22)


@has_oidn
@pytest.mark.parametrize("quality", ["fast", "balanced", "high"])
@pytest.mark.parametrize("missing", [{}, {"normal": None}, {"normal": None, "albedo": None}])
def test_filters_equal_those_of_the_library(quality: Any, missing: dict[str, None]) -> None:
    frame = lit().replace(**missing)
    filters, library = OpenFilters(quality, prefilter=None), Oidn(quality, threads=1)
    exposure = oidn_exposure(frame.color)
    for auxiliary in ("noisy", "clean"):
        image, expected = (compress(each.denoised(frame, auxiliary) * exposure) for each in (filters, library))
        torch.testing.assert_close(image, expected, rtol=0, atol=20 * 2.0**-22)
    clean, expected_frame = (each.with_clean_features(frame, quality) for each in (filters, library))
    for name in ("albedo", "normal"):
        if (expected := expected_frame.buffer(name)) is not None:
            # The slope of the inverse sRGB curve is at most 2.3, that of a normal's scale 2.
            torch.testing.assert_close(clean.buffer(name), expected, rtol=0, atol=2.3 * 20 * 2.0**-22)
    assert not filters.state_dict()


@has_oidn
def test_its_derivative_is_the_difference_quotient_of_the_library() -> None:
    # Away from the ends of the scale, where the library clamps.
    frame = lit(32, 48)
    frame = frame.replace(color=0.5 + frame.albedo)
    model = without_border(create_model(NAME))
    library = Oidn("high", threads=1)
    # The exposure, which has no derivative, is that of the luminance: the change leaves that of every bin as it is.
    change = torch.randn(1, 3, 32, 48) * 0.05 * frame.color
    weights = torch.tensor([0.212671, 0.715160, 0.072169]).reshape(1, 3, 1, 1)
    change = change - (change * weights).sum(1, keepdim=True) / weights.sum()
    step = 2.0**-4
    apart = [library(frame.replace(color=frame.color + sign * step * change))[0].image for sign in (1, -1)]
    expected = (apart[0] - apart[1]) / (2 * step)
    color = frame.color.clone().requires_grad_()
    image = model(frame.replace(color=color))[0].image
    (slope,) = torch.autograd.grad(image, color, expected)
    # Along the change, weighed with itself. ReLUs and pools change sides on the way, over so small a step
    # few of them.
    assert float((slope * change).sum()) == pytest.approx(float(expected.square().sum()), rel=0.05)


@has_oidn
def test_tiles_are_the_whole_image() -> None:
    whole, tiles = Denoiser(NAME), Denoiser(NAME, tile=64)
    frame = frame_of(200, 330)
    torch.testing.assert_close(tiles(frame), whole(frame), rtol=1e-4, atol=1e-5)
    assert tiles.report.tiles.startswith("6 x 4 tiles")


@pytest.mark.parametrize("size", ["small", "base", "large"])
@pytest.mark.parametrize("shape", [(1, 16, 16), (2, 16, 16), (2, 48, 32), (2, 30, 37)], ids=str)
def test_features_that_are_upsampled_implicitly_give_the_same(size: Any, shape: tuple[int, int, int]) -> None:
    """Without derivatives a layer convolves the features that are not upsampled yet."""
    batch, height, width = shape
    torch.manual_seed(0)
    unet = OidnUNet(12, size, 7)
    for layer in unet.convolutions:
        torch.nn.init.normal_(layer.bias, std=0.1)  # type: ignore[arg-type]
    x = torch.rand(batch, 12, height, width)
    expected = unet.double()(x.double()).detach()
    unet.float()
    for dtype in (torch.float32, torch.bfloat16):
        errors = []
        for derivatives in (True, False):
            with torch.set_grad_enabled(derivatives), torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
                result = unet(x)
            assert result.requires_grad is derivatives
            errors.append(float((result.detach() - expected).abs().mean()))
        # One more rounding in 4 of 16 layers, and one of sums of weights.
        assert 0 < errors[0] < 0.1 * float(expected.abs().mean())
        assert errors[1] < 1.5 * errors[0]


@pytest.mark.parametrize("size", ["small", "base", "large"])
def test_a_pixel_farther_than_the_reach_changes_nothing(size: Any) -> None:
    torch.manual_seed(0)
    unet = OidnUNet(9, size).eval()
    side = 2 * unet.reach + 33
    x = torch.rand(1, 9, 16, side)
    other = x.clone()
    other[..., 0] += 100
    with torch.no_grad():
        changed = (unet(x) != unet(other)).any(1)[0].any(0)
    assert changed[0]
    assert not changed[unet.reach + 1 :].any()


def test_the_scale_of_radiance() -> None:
    dark, bright = math.log10(1e-9), math.log10(MAX_RADIANCE)
    radiance = torch.cat([torch.zeros(1), torch.logspace(dark, bright, 4001, dtype=torch.float64)])
    scale = compress(radiance)
    assert scale[0] == 0
    assert float(scale[-1]) == pytest.approx(1, abs=1e-9)
    assert (scale.diff() > 0).all()
    torch.testing.assert_close(expand(scale), radiance, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("function", [compress, expand])
def test_derivatives_of_the_scale(function: Any) -> None:
    # Inside of each of its three parts.
    values = torch.tensor([1e-6, 1e-3, 5.0] if function is compress else [5e-4, 0.05, 0.4], dtype=torch.float64)
    assert torch.autograd.gradcheck(function, values.requires_grad_(), eps=1e-8, atol=1e-5)
    edge = torch.tensor([0.0, 1.0], requires_grad=True)
    function(edge).sum().backward()
    assert edge.grad.isfinite().all()


@pytest.mark.parametrize("size", [(16, 16), (17, 40), (100, 77), (5, 3)])
def test_exposure_bin_by_bin(size: tuple[int, int]) -> None:
    color = lit(*size).color
    color[..., : size[0] // 2, : size[1] // 2] = 0
    weights = (0.212671, 0.715160, 0.072169)
    luminance = sum(weight * color[0, channel].double() for channel, weight in enumerate(weights)).numpy()  # type: ignore
    counts = [-(-side // 16) for side in size]
    logarithms = []
    for row, column in itertools.product(*map(range, counts)):
        tall, wide = (
            slice(i * side // n, (i + 1) * side // n) for i, side, n in zip((row, column), size, counts, strict=True)
        )
        mean = luminance[tall, wide].mean()
        if mean > 1e-8:
            logarithms.append(math.log2(mean))
    expected = 0.18 / 2 ** np.mean(logarithms)
    assert oidn_exposure(color).item() == pytest.approx(expected, rel=1e-5)
    assert oidn_exposure(torch.zeros(2, 3, 20, 20)).flatten().tolist() == pytest.approx([0.18e30] * 2)


@pytest.mark.parametrize("factor", [2.0**-60, 2.0**-100])
def test_a_dim_image_has_the_exposure_of_a_bright_one(factor: float) -> None:
    color = lit(40, 33).color
    assert (oidn_exposure(factor * color) * factor).item() == pytest.approx(oidn_exposure(color).item(), rel=1e-5)


def archive(tensors: dict[str, np.ndarray[Any, Any]], before: bytes = b"") -> bytes:
    """An archive as the library's scripts write it: values on multiples of 64, and the table behind them."""
    values, table = b"", struct.pack("<I", len(tensors))
    start = 64
    for name, tensor in tensors.items():
        kind = {"float32": b"f", "float16": b"h"}[tensor.dtype.name]
        layout = "oihw"[: tensor.ndim].encode() if tensor.ndim == 4 else b"x"
        table += struct.pack("<H", len(name)) + name.encode() + struct.pack("<B", tensor.ndim)
        table += struct.pack(f"<{tensor.ndim}I", *tensor.shape) + layout + kind
        table += struct.pack("<Q", start + len(values))
        values += tensor.tobytes() + b"\0" * (-tensor.nbytes % 64)
    head = struct.pack("<HBBQ", 0x41D7, 2, 0, start + len(values)).ljust(start, b"\0")
    return before + head + values + table


def weights_of(unet: OidnUNet) -> dict[str, np.ndarray[Any, Any]]:
    found = {}
    for index, layer in enumerate(unet.convolutions):
        found[f"conv{index}.weight"] = layer.weight.detach().numpy().astype(np.float16)
        found[f"conv{index}.bias"] = np.full(len(layer.weight), index / 8, np.float32)
    return found


def test_a_network_of_a_file_of_one_s_own(tmp_path: Path) -> None:
    torch.manual_seed(0)
    path = tmp_path / "mine.tza"
    path.write_bytes(archive(weights_of(OidnUNet(9, "small"))))
    model = create_model(NAME, quality="fast", archive=path)
    layers = model.inner.unet.convolutions  # type: ignore[attr-defined]
    tensors = read_tza(path)
    assert len(tensors) == 2 * len(layers)
    for index, layer in enumerate(layers):
        assert torch.equal(layer.weight, tensors[f"conv{index}.weight"])
        assert torch.equal(layer.bias, torch.full_like(layer.bias, index / 8))
    message = refused(lambda: create_model(NAME, archive=path))
    assert "expected weights of shape (48, 32, 3, 3), found (32, 32, 3, 3)" in message


def test_archives_are_found_in_a_library(tmp_path: Path) -> None:
    path = tmp_path / "library.so"
    one, other = {"a": np.arange(4, dtype=np.float32)}, {"b": np.ones((1, 2, 3, 3), np.float16)}
    # The mark alone, by chance, is no archive.
    chance = struct.pack("<HBBQ", 0x41D7, 2, 0, 1 << 60)
    path.write_bytes(archive(one, b"x" * 77) + chance + archive(other, b"y" * 13) + chance)
    first, second = archives_in(path)
    assert first["a"].tolist() == [0, 1, 2, 3]
    assert second["b"].shape == (1, 2, 3, 3)


def test_refuses_a_file_that_is_no_archive(tmp_path: Path) -> None:
    path = tmp_path / "mine.tza"
    assert f"{path}: expected an archive of weights" in refused(lambda: read_tza(path))
    path.write_bytes(b"PK\x03\x04")
    assert "(.tza, version 2), found another" in refused(lambda: read_tza(path))
    whole = archive({"a": np.arange(4000, dtype=np.float32)})
    for length in (4, 12, 100, len(whole) - 3):
        path.write_bytes(whole[:length])
        assert "found a damaged one" in refused(lambda: read_tza(path))
    path.write_bytes(whole[:12] + b"\xff" * (len(whole) - 12))
    assert "found a damaged one" in refused(lambda: read_tza(path))
