"""The family ``cascaded_v2``: what goes beyond the paper's network."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from toys import frame_of, small

from mcdenoise import ops
from mcdenoise.frame import Frame
from mcdenoise.models import Chain, CoarseToFine, create_model, overview, parts_of
from mcdenoise.models import cascaded_v2 as page
from mcdenoise.models.cascaded_v2 import KernelNetwork, PixelNetwork
from mcdenoise.nn import auto_exposure
from mcdenoise.nn.inputs import FEATURES
from mcdenoise.ops import cross_bilateral_weights, kernel_conv

WIDTH = 8


def networks(model: Any) -> tuple[PixelNetwork, KernelNetwork]:
    return next(parts_of(model, PixelNetwork)), next(parts_of(model, KernelNetwork))


def chain_of(model: Any) -> Chain:
    """Both networks without their wrappers, on radiance as it is given."""
    return next(parts_of(model, Chain))


def widths(name: str, **settings: Any) -> tuple[int, ...]:
    return tuple(network.heads[0].in_channels for network in networks(create_model(name, **settings)))


@pytest.mark.parametrize(
    ("name", "expected", "taps"),
    [
        ("cascaded_v2", (40, 40), 25),
        ("cascaded_v2_small", (16, 32), 25),
        ("cascaded_v2_tiny", (16, 16), 9),
        ("cascaded_v2_micro", (16, 16), 9),
    ],
)
def test_the_sizes_of_the_family(name: str, expected: tuple[int, int], taps: int) -> None:
    pixel, kernel = networks(create_model(name))
    assert widths(name) == expected
    # At half the resolution, a feature stands for two by two pixels.
    finest = 4 if name == "cascaded_v2_micro" else 1
    assert [head.out_channels for head in kernel.heads] == [finest * (taps + 3), taps + 3, taps + 3]
    assert [head.out_channels for head in pixel.heads] == [finest * 3, 3, 3]
    assert next(parts_of(create_model(name), CoarseToFine)).resolutions == 3


def test_the_width_of_the_kernel_network_can_be_set() -> None:
    assert widths("cascaded_v2", width=8) == (8, 8)
    assert widths("cascaded_v2", width=8, kernel_width=12) == (8, 12)
    assert widths("cascaded_v2_small", width=8) == (8, 32)
    assert widths("cascaded_v2_small", width=8, kernel_width=None) == (8, 8)


@pytest.mark.slow
@torch.no_grad()
def test_full_width_at_180x320() -> None:
    output, _ = create_model("cascaded_v2")(frame_of(180, 320))
    for image in (output.image, output.stages["initial"]):
        assert image.shape == (1, 3, 180, 320)
        assert torch.isfinite(image).all()


@pytest.mark.parametrize("precision", [torch.float32, pytest.param(torch.bfloat16, marks=pytest.mark.slow)], ids=str)
@pytest.mark.parametrize(
    "name",
    [
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("cascaded_v2", "cascaded_v2_tiny")),
        "cascaded_v2_micro",
    ],
)
def test_weights_and_filter_in_one_give_the_same_image(
    name: str, precision: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = create_model(name, pretrained=True)
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


def test_kernels_keep_a_constant_image() -> None:
    torch.manual_seed(0)
    network, frame = KernelNetwork(WIDTH), frame_of(13, 18)
    frame = frame.replace(color=torch.full((1, 3, 13, 18), 0.7))
    with torch.no_grad():
        image = network(frame)[0].image
    torch.testing.assert_close(image, torch.full_like(image, 0.7), rtol=0, atol=1e-5)


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


@pytest.mark.slow
def test_large_images_have_the_derivatives_of_the_reference() -> None:
    """Large enough for fast backends, some of which have no derivatives."""
    gradients = []
    for backend in ("torch", "numba"):
        torch.manual_seed(0)
        model = create_model("cascaded_v2", width=8)
        assert isinstance(model, nn.Module)
        for head in networks(model)[0].heads:
            nn.init.normal_(head.weight, std=0.1)
        with ops.use(backend, strict=False):
            model(frame_of(96, 110))[0].image.mean().backward()
        gradients.append([parameter.grad for parameter in model.parameters()])
    for fast, plain in zip(*gradients, strict=True):
        torch.testing.assert_close(fast, plain, rtol=1e-3, atol=1e-6)


def test_initial_weights() -> None:
    """Their results change only together with the architecture, and then every file of weights is void."""
    torch.manual_seed(0)
    model = create_model("cascaded_v2", width=8)
    grid = torch.linspace(0, 1, 8 * 9).reshape(1, 1, 8, 9)
    color = torch.cat([grid, 1 - grid, (7 * grid) % 1], 1)
    frame = Frame(color, albedo=color.flip(1), normal=color * 2 - 1, depth=1 + grid, current=color)
    with torch.no_grad():
        # In training there is no mirror image around the frame.
        output, _ = chain_of(model).train()(frame)
    initial, final = output.stages["initial"], output.image
    expected_initial = [[0.507042, 0.563380, 0.619718], [0.492958, 0.436620, 0.380282], [0.549296, 0.943662, 0.338028]]
    expected_final = [[0.516916, 0.587703, 0.614132], [0.480873, 0.412624, 0.385203], [0.600575, 0.852206, 0.312455]]
    torch.testing.assert_close(initial[0, :, 4, ::4], torch.tensor(expected_initial), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(final[0, :, 4, ::4], torch.tensor(expected_final), rtol=1e-4, atol=1e-5)


def test_the_cost_of_the_family() -> None:
    macs = {entry.name: entry.kmacs_per_pixel or 0.0 for entry in overview("cascaded_v2*")}
    cost = {name: own / macs["cascaded_v2"] for name, own in macs.items()}
    assert cost["cascaded_v2_small"] == pytest.approx(0.41, abs=0.005)
    assert cost["cascaded_v2_tiny"] == pytest.approx(0.18, abs=0.005)
    assert cost["cascaded_v2_micro"] == pytest.approx(0.08, abs=0.005)


def test_the_cost_of_the_pixel_network_written_out() -> None:
    width = 8
    full = (3 + FEATURES + width) * width * 9
    # At each coarser scale it is given the mean of the image.
    encoder = sum((2 * width + 3) * width * 9 / 4**level for level in (1, 2, 3))
    # A 2x2 transposed convolution, two convolutions of which the first sees the encoder too, and a head.
    decoder = sum((width**2 + 3 * width * width * 9 + 3 * width * 9) / 4**level for level in (0, 1, 2))
    fusions = sum(6 * 9 / 4**level for level in (0, 1))
    from torch.utils.flop_counter import FlopCounterMode

    with FlopCounterMode(display=False) as counter:
        PixelNetwork(width)(frame_of(64, 64))
    assert counter.get_total_flops() / 2 / 64**2 == pytest.approx(full + encoder + decoder + fusions, rel=1e-6)


@torch.no_grad()
def test_buffers_of_ones_own_change_nothing() -> None:
    model, frame = small("cascaded_v2_micro"), frame_of(24, 40)
    expected = model(frame)[0].image
    assert torch.equal(model(frame.replace(extra={"matte": torch.rand(1, 2, 24, 40)}))[0].image, expected)
