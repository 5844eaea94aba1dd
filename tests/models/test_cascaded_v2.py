"""The family ``cascaded_v2``: what goes beyond the paper's network."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from toys import frame_of, small

from mcdenoise import ops
from mcdenoise.frame import Frame
from mcdenoise.models import Chain, CoarseToFine, create_model
from mcdenoise.models import cascaded_v2 as page
from mcdenoise.models._wrapper import parts_of
from mcdenoise.models.cascaded_v2 import KernelNetwork, PixelNetwork
from mcdenoise.nn import auto_exposure
from mcdenoise.ops import cross_bilateral_weights, kernel_conv

WIDTH = 8


def networks(model: Any) -> tuple[PixelNetwork, KernelNetwork]:
    return next(parts_of(model, PixelNetwork)), next(parts_of(model, KernelNetwork))


def chain_of(model: Any) -> Chain:
    """Both networks without their wrappers, on radiance as it is given."""
    return next(parts_of(model, Chain))


@pytest.mark.parametrize("precision", [torch.float32, pytest.param(torch.bfloat16, marks=pytest.mark.slow)], ids=str)
def test_weights_and_filter_in_one_give_the_same_image(precision: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    model = create_model("cascaded_v2_micro", pretrained=True)
    assert isinstance(model, nn.Module)
    model = model.to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
    bfloat16 = torch.autocast("cpu", torch.bfloat16, enabled=precision == torch.bfloat16)
    in_one, calls = page.cross_bilateral_filter, []
    with torch.no_grad(), bfloat16:
        image = model(frame_of(97, 131))[0].image

        def in_two_steps(image: Tensor, logits: Tensor, *arguments: Any, border: Any) -> Tensor:
            expected = in_one(image, logits, *arguments, border=border)
            with ops.use("torch"):
                weights = cross_bilateral_weights(logits.float(), *arguments, border=border)
                filtered = kernel_conv(image, weights, border="zeros")
            torch.testing.assert_close(filtered, expected, rtol=1e-4, atol=1e-5)
            calls.append(filtered)
            # The input of the next network is rounded to 8 bits in bfloat16, now and then to the other side.
            return filtered if precision == torch.float32 else expected

        monkeypatch.setattr(page, "cross_bilateral_filter", in_two_steps)
        torch.testing.assert_close(image, model(frame_of(97, 131))[0].image, rtol=1e-4, atol=1e-5)
    assert len(calls) == 3


def test_without_a_history_a_frame_is_all_there_is() -> None:
    chain = chain_of(small("cascaded_v2"))
    for weight in chain.parameters():
        nn.init.normal_(weight, std=0.1)
    frame, length = frame_of(13, 18), torch.ones(1, 1, 13, 18)
    frame = frame.replace(current=frame.color)
    with torch.no_grad():
        alone = chain(frame)[0].image
        assert torch.equal(chain(frame.replace(length=length))[0].image, alone)
        # Without a buffer for the current frame, the first network uses the frame's color for it.
        pixel = networks(chain)[0]
        assert torch.equal(pixel(frame.replace(current=None))[0].image, pixel(frame)[0].image)
        for other in (frame.replace(current=2 * frame.color, length=length), frame.replace(length=4 * length)):
            assert not torch.allclose(chain(other)[0].image, alone, rtol=1e-3)


def test_filtered_pixels_lie_between_those_of_the_input() -> None:
    torch.manual_seed(0)
    network = KernelNetwork(WIDTH)
    # With alpha = 0 the fusion keeps the finest scale: what is left are weighted means of the input.
    for fusion in network.fusions:
        nn.init.zeros_(fusion.conv.weight)
        nn.init.constant_(fusion.conv.bias, -1e4)
    image = torch.rand(1, 3, 13, 18) + 0.5
    with torch.no_grad():
        filtered = network(Frame(image))[0].image
    low, high = image.amin((2, 3), keepdim=True), image.amax((2, 3), keepdim=True)
    assert (filtered >= low - 1e-5).all()
    assert (filtered <= high + 1e-5).all()
    assert filtered.std() < image.std()


def test_a_pixel_network_at_rest_keeps_a_constant_image_and_never_outshines_its_input() -> None:
    torch.manual_seed(0)
    network, frame = PixelNetwork(WIDTH), frame_of(13, 18)
    constant = torch.full((1, 3, 13, 18), 0.7)
    with torch.no_grad():
        torch.testing.assert_close(network(frame.replace(color=constant))[0].image, constant, rtol=0, atol=1e-5)
        for head in network.heads:
            nn.init.constant_(head.bias, 100.0)
        assert network(frame)[0].image.max() <= frame.color.max() * (1 + 1e-5)


def test_a_pixel_network_is_given_the_means_of_its_image_at_coarser_scales() -> None:
    network, frame = networks(small("cascaded_v2"))[0], frame_of(13, 22)
    given: list[list[Tensor]] = []
    network.unet.register_forward_pre_hook(lambda _, arguments: given.append(arguments[1]))
    network(frame)
    image = frame.color * auto_exposure(frame.color)
    for scale, mean in zip((2, 4, 8), given[0], strict=True):
        expected = image.unfold(2, scale, scale).unfold(3, scale, scale).mean((-2, -1))
        whole = (slice(None), slice(None), slice(13 // scale), slice(22 // scale))
        torch.testing.assert_close(mean[whole], torch.log1p(expected))


@torch.no_grad()
def test_lower_resolutions_see_further() -> None:
    """Half the resolution depends on a pixel that is 70 pixels away, and a quarter of it on one that is 150 away."""
    coarse, frame = next(parts_of(small("cascaded_v2"), CoarseToFine)), frame_of(64, 640)
    assert frame.albedo is not None
    for distance, resolutions in ((70, 2), (150, 3)):
        # The exposure does not depend on the albedo.
        albedo = frame.albedo.clone()
        albedo[..., distance : distance + 16] = 1 - albedo[..., distance : distance + 16]
        changes = []
        for coarse.resolutions in (resolutions - 1, resolutions):
            change = coarse(frame.replace(albedo=albedo))[0].image - coarse(frame)[0].image
            changes.append(float(change[..., 0].abs().max()))
        assert changes[0] == 0 < changes[1]


@pytest.mark.parametrize("size", [(33, 47), (96, 110)])
@torch.no_grad()
def test_a_constant_guide_is_no_guide(size: tuple[int, int]) -> None:
    """A depth of any constant, and none, are the same; so is what is infinite everywhere."""
    network, frame = networks(small("cascaded_v2"))[1], frame_of(*size)
    expected = network(frame.replace(depth=None))[0].image
    constant = network(frame.replace(depth=torch.full((1, 1, *size), 3.7)))[0].image
    torch.testing.assert_close(constant, expected, rtol=1e-5, atol=1e-6)
    assert not torch.allclose(network(frame)[0].image, expected, rtol=1e-3)


@torch.no_grad()
def test_buffers_of_ones_own_change_nothing() -> None:
    model, frame = small("cascaded_v2_micro"), frame_of(24, 40)
    expected = model(frame)[0].image
    assert torch.equal(model(frame.replace(extra={"matte": torch.rand(1, 2, 24, 40)}))[0].image, expected)
