"""The paper's network against its equations, in float64, with those of the ops as loops over pixels."""

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from oracles import filters, resolutions
from torch import Tensor
from toys import drawn, frame_of, small, whole_frame

from mcdenoise.frame import Frame
from mcdenoise.models import Chain, create_model
from mcdenoise.models._wrapper import parts_of
from mcdenoise.models.cascaded import KernelNetwork, PixelNetwork
from mcdenoise.nn import auto_exposure

SIZE = (7, 9)


def networks(model: Any) -> list[PixelNetwork | KernelNetwork]:
    chain = next(parts_of(model, Chain))
    return [part for part in chain.modules() if isinstance(part, PixelNetwork | KernelNetwork)]


def fused(network: Any, images: list[Tensor]) -> Tensor:
    """Eq. 2 from the coarsest scale to the finest."""
    coarse = images[-1]
    for fine, module in zip((images[1], images[0]), network.fusions, strict=True):
        above = resolutions.upsample(coarse, (fine.shape[-2], fine.shape[-1]))
        alpha = torch.sigmoid(F.conv2d(torch.cat([fine, above], 1), module.conv.weight, module.conv.bias, padding=1))
        assert alpha.shape[1] == 1
        coarse = resolutions.laplacian_fusion(fine, coarse, alpha)
    return coarse


def features(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
    depth = frame.depth
    hit = torch.isfinite(depth)
    typical = torch.exp(torch.log(depth[hit]).mean())
    near = torch.where(hit, depth / (depth + typical), 1)
    return frame.albedo, (frame.normal + 1) / 2, near


def predictions(network: Any, frame: Frame) -> list[Tensor]:
    levels = network.unet(torch.cat([frame.color, *features(frame)], 1))
    return [
        F.conv2d(level, head.weight, head.bias, padding=1) for level, head in zip(levels, network.heads, strict=True)
    ]


@pytest.mark.parametrize("size", [SIZE, (8, 8), (1, 1)])
@torch.no_grad()
def test_the_pixel_network_written_out(size: tuple[int, int]) -> None:
    """Eqs. 1 and 2."""
    network, frame = drawn(PixelNetwork(8)), frame_of(*size, batch=2 if size == (8, 8) else 1).to(torch.float64)
    if len(frame.color) == 2:
        # The typical depth is that of each image.
        single = [frame.map(lambda image, i=i: image[i : i + 1]) for i in (0, 1)]
        expected = torch.cat([fused(network, predictions(network, one)) for one in single])
    else:
        expected = fused(network, predictions(network, frame))
    output, state = network(frame)
    assert state is None
    torch.testing.assert_close(output.image, expected, rtol=1e-9, atol=1e-10)
    assert expected.abs().max() > 0.1


@pytest.mark.parametrize(
    ("kernel_size", "bilateral", "normalize"), [(3, True, "softmax"), (5, False, "softmax"), (3, True, "none")]
)
@torch.no_grad()
def test_the_kernel_network_written_out(kernel_size: int, bilateral: bool, normalize: Any) -> None:
    """Eqs. 3 to 8, and their fusion by Eq. 2."""
    network = drawn(KernelNetwork(8, kernel_size, bilateral, normalize))
    frame = frame_of(*SIZE).to(torch.float64)
    image, (_, normal, depth) = frame.color, features(frame)
    images = []
    for scale, predicted in enumerate(predictions(network, frame)):
        if scale:
            image, normal, depth = (resolutions.downsample(each) for each in (image, normal, depth))
        logits, rest = predicted[:, : kernel_size**2], predicted[:, kernel_size**2 :]
        assert rest.shape[1] == (3 if bilateral else 0)
        *of_features, of_distance = torch.log1p(torch.exp(rest)).split(1, 1) if bilateral else [None]
        guides = [normal, depth] if bilateral else []
        images.append(
            filters.cross_bilateral_filter(image, logits, guides, of_features, of_distance, normalize=normalize)
        )
    output, _ = network(frame)
    torch.testing.assert_close(output.image, fused(network, images), rtol=1e-9, atol=1e-10)


@torch.no_grad()
def test_the_whole_method_written_out() -> None:
    """A first frame: demodulation, exposure, P, K, and what is below zero is cut off."""
    model = create_model("cascaded", width=8)
    drawn(model)
    frame = frame_of(*SIZE).to(torch.float64)
    textured = (frame.albedo >= 1e-4).any(1, keepdim=True)
    assert textured.all()
    divisor = frame.albedo.clamp_min(0.04)
    pixel, kernel = networks(model)
    demodulated = frame.color / divisor
    exposure = auto_exposure(demodulated)
    seen = frame.replace(color=demodulated * exposure)
    initial = fused(pixel, predictions(pixel, seen))
    final = kernel(seen.replace(color=initial))[0].image
    # In training there is no mirror image around the frame.
    output, _ = model.train()(frame)
    assert list(output.stages) == ["accumulated", "initial"]
    torch.testing.assert_close(output.stages["accumulated"], frame.color, rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(output.stages["initial"], initial / exposure * divisor, rtol=1e-9, atol=1e-10)
    assert (final < 0).any()
    torch.testing.assert_close(output.image, (final / exposure).clamp_min(0) * divisor, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(("bilateral", "normalize"), [(True, "softmax"), (False, "none")])
@pytest.mark.parametrize("cascade", ["P", "K", "P+K", "K+P", "K+K"])
@torch.no_grad()
def test_the_ablations(cascade: str, bilateral: bool, normalize: Any) -> None:
    model = small("cascaded", cascade=cascade, bilateral=bilateral, normalize=normalize)
    parts = networks(model)
    assert "+".join("P" if isinstance(part, PixelNetwork) else "K" for part in parts) == cascade
    for part in parts:
        if isinstance(part, KernelNetwork):
            assert (part.bilateral, part.normalize) == (bilateral, normalize)
            assert {head.out_channels for head in part.heads} == {28 if bilateral else 25}
    frame = whole_frame(model, 17, 20)
    output, _ = model(frame)
    assert list(output.stages) == ["accumulated", *(["initial"] if len(parts) > 1 else [])]
    assert torch.isfinite(output.image).all()
    assert (output.image >= 0).all()
    assert not torch.equal(output.image, frame.color)
