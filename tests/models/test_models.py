"""What every model of the zoo promises, whatever its weights are; the tests read the register."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mcdenoise.models._regions import halved, regions
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.models import (
    Cascade,
    Denoised,
    Head,
    KernelPredictor,
    Known,
    PixelPredictor,
    Region,
    UNet,
    cascaded,
    create_model,
    describe_weights,
    list_models,
    load_weights,
    overview,
    pretrained_models,
    register_model,
    save_weights,
)
from mcdenoise.models.cascaded import FEATURES, auto_exposure, normalize_depth
from mcdenoise.ops import cross_bilateral_weights, downsample, kernel_conv
from mcdenoise.ops._backend import preferred
from mcdenoise.ops._steps.network import low_frequencies_of

SHIPPED = Path(__file__).parents[2] / "mcdenoise" / "models" / "weights"
WIDTH = 8


def build(name: str, **settings: Any) -> nn.Module:
    """A small model off its initial values: at rest, a pixel network's heads are zero and hide everything before."""
    torch.manual_seed(1)
    model = create_model(name, **{"width": WIDTH, **settings})
    for part in model.modules():
        if isinstance(part, PixelPredictor):
            for head in part.heads:
                nn.init.normal_(head.weight, std=0.02)
    return model


def inputs(height: int, width: int, batch: int = 1, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Color, albedo, normal and depth, with background in the first row of larger images."""
    generator = torch.Generator().manual_seed(seed)
    color, albedo, normal, depth = (
        torch.rand(batch, channels, height, width, generator=generator) for channels in (3, 3, 3, 1)
    )
    depth = 1 + 9 * depth
    if height > 1:
        depth[:, :, 0] = torch.inf
    return color.square() * 4, albedo, nn.functional.normalize(normal - 0.5, dim=1), depth


def refused(action: Callable[[], object]) -> str:
    with pytest.raises(InputError) as error:
        action()
    assert "\n" not in str(error.value)
    return str(error.value)


# What a name stands for: the cascade as in the paper's Table 3, and whether kernels have bilateral weights.
CASCADES = {
    "pixel": ("P", None),
    "kernel": ("K", True),
    "kernel_plain": ("K", False),
    "kernel_pixel": ("K+P", True),
    "kernel_pixel_plain": ("K+P", False),
    "kernel_kernel": ("K+K", True),
    "kernel_kernel_plain": ("K+K", False),
    "cascaded": ("P+K", True),
    "cascaded_plain": ("P+K", False),
    "cascaded_small": ("P+K", True),
    "cascaded_tiny": ("P+K", True),
    "cascaded_micro": ("P+K", True),
}


@pytest.mark.parametrize(("name", "cascade", "bilateral"), [(name, *what) for name, what in CASCADES.items()])
def test_names_of_the_ablation(name: str, cascade: str, bilateral: bool | None) -> None:
    model = build(name)
    assert isinstance(model, Cascade)
    parts = [part for part in (model.first, model.second) if part is not None]
    assert "+".join("P" if isinstance(part, PixelPredictor) else "K" for part in parts) == cascade
    assert all(part.bilateral is bilateral for part in parts if isinstance(part, KernelPredictor))


def test_the_register() -> None:
    assert set(CASCADES) <= set(list_models())
    assert list_models("kernel_kernel*") == ["kernel_kernel", "kernel_kernel_plain"]
    assert "cascaded" in refused(lambda: create_model("oidn"))
    with pytest.raises(ValueError, match="'cascaded' is registered twice"):
        register_model("cascaded")(nn.Identity)


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (17, 33)], ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("name", list_models())
def test_odd_sizes(name: str, size: tuple[int, int]) -> None:
    with torch.no_grad():
        result = build(name)(*inputs(*size))
    for image in result:
        assert image.shape == (1, 3, *size)
        assert torch.isfinite(image).all()
        assert (image >= 0).all()


def test_full_width_at_180x320() -> None:
    with torch.no_grad():
        initial, final = create_model("cascaded")(*inputs(180, 320))
    assert initial.shape == final.shape == (1, 3, 180, 320)
    assert torch.isfinite(final).all()


@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16], ids=str)
@pytest.mark.parametrize("name", ["cascaded", "cascaded_tiny"])
def test_weights_and_filter_in_one_give_the_same_image(
    name: str, precision: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = create_model(name, pretrained=True).to(memory_format=torch.channels_last).eval()
    bfloat16 = torch.autocast("cpu", torch.bfloat16, enabled=precision == torch.bfloat16)
    in_one, calls = cascaded.cross_bilateral_filter, []
    with torch.no_grad(), bfloat16:
        image = model(*inputs(97, 131)).final

        def in_two_steps(image: Tensor, logits: Tensor, *arguments: Any, border: Any, backend: Any) -> Tensor:
            weights = cross_bilateral_weights(logits.float(), *arguments, border=border)
            filtered = kernel_conv(image, weights, border="zeros", backend="torch")
            expected = in_one(image, logits, *arguments, border=border, backend=backend)
            torch.testing.assert_close(filtered, expected, rtol=1e-4, atol=1e-5)
            calls.append(filtered)
            # What the next network reads is rounded to 8 bits in bfloat16, now and then to the other side.
            return filtered if precision == torch.float32 else expected

        monkeypatch.setattr(cascaded, "cross_bilateral_filter", in_two_steps)
        torch.testing.assert_close(image, model(*inputs(97, 131)).final, rtol=1e-4, atol=1e-5)
    assert len(calls) == 3


def whole_numbers(parameter: Tensor, generator: torch.Generator) -> Tensor:
    """Of the weights of a convolution, two are 1 or -1 for each result and all others 0; no bias."""
    values = torch.zeros(parameter.shape)
    if parameter.dim() > 1:
        # Transposed convolutions have their results second, and one weight of each input for each of two by two.
        outputs = values.transpose(0, 1) if parameter.shape[-1] == 2 else values
        for output in range(outputs.shape[0]):
            for place in torch.randperm(outputs[0].numel(), generator=generator)[:2].tolist():
                sign = 1.0 if torch.rand((), generator=generator) < 0.7 else -1.0
                outputs[(output, *np.unravel_index(place, outputs[0].shape))] = sign
    return values


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_shortcuts_of_inference_change_no_feature(dtype: torch.dtype) -> None:
    """Bit by bit, of a network whose sums have no rounding in whichever order a library takes them."""
    net, generator = UNet(4, WIDTH), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.copy_(whole_numbers(parameter, generator))
    net = net.to(dtype=dtype, memory_format=torch.channels_last)
    # Each of the 17 layers at most doubles them: whole numbers below 2^20, and float32, in which all sums are taken,
    # holds those below 2^24. bfloat16 rounds the results only, before or after ReLU, which is the same.
    image = torch.randint(-4, 5, (1, 4, 21, 34), generator=generator).to(dtype)
    trained = net(image)
    with torch.no_grad():
        inferred = net(image)
    for a, b in zip(trained, inferred, strict=True):
        assert len(b.unique()) > 20
        assert torch.equal(a, b)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_shortcuts_of_inference_change_no_convolution_by_more_than_rounding(dtype: torch.dtype) -> None:
    """Of ``n`` products, sums in two orders differ by ``2 gamma_n`` times the sum of their absolute values, at most.

    ``gamma_n = n u / (1 - n u)`` with the ``u`` of float32 (Higham 2002, Sec. 3.1). What a first convolution differs by
    the second one multiplies by its weights. A result in bfloat16 is rounded once more, by up to its ``u``.
    """
    torch.manual_seed(0)
    net = UNet(4, WIDTH).to(dtype=dtype, memory_format=torch.channels_last)
    entering: list[tuple[nn.Module, Tensor]] = []
    blocks = [*net.encoder, *net.decoder]
    for block in blocks:
        block.register_forward_pre_hook(lambda block, inputs: entering.append((block, inputs[0].detach().clone())))
    with torch.no_grad():
        net(torch.randn(1, 4, 21, 34).to(dtype))
    unit = torch.finfo(torch.float32).eps / 2
    rounding = 0.0 if dtype == torch.float32 else torch.finfo(dtype).eps / 2
    # The list grows while they are called again.
    for block, x in entering[: len(blocks)]:
        trained = block(x.clone()).detach()
        with torch.no_grad():
            inferred = block(x.clone())
        magnitude, bound = x.double().abs(), torch.zeros_like(x, dtype=torch.float64)
        for layer in block:
            if isinstance(layer, nn.Conv2d):
                weight, bias = layer.weight.detach().double().abs(), layer.bias.detach().double().abs()
                gamma = (count := weight[0].numel() + 1) * unit / (1 - count * unit)
                carried = nn.functional.conv2d(bound, weight, None, layer.stride, layer.padding)
                # Of all absolute values: also an upper bound of the results.
                magnitude = nn.functional.conv2d(magnitude + bound, weight, bias, layer.stride, layer.padding)
                bound = carried + (2 * gamma + 2 * rounding) * magnitude
        assert ((trained.double() - inferred.double()).abs() <= bound).all()
        assert bound.max() < (1e-3 if dtype == torch.float32 else 2) * trained.max()


def test_shortcuts_of_training_change_no_derivative(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    net = UNet(4, WIDTH).to(dtype=torch.bfloat16, memory_format=torch.channels_last)
    image = torch.randn(1, 4, 21, 34).bfloat16()

    def derivatives() -> tuple[list[Tensor], list[Tensor]]:
        parameters = list(net.parameters())
        on_record, plain = (
            torch.autograd.grad(sum(f.square().sum() for f in net(image)), parameters, create_graph=record)
            for record in (True, False)
        )
        assert all(map(torch.equal, on_record, plain))
        second = torch.autograd.grad(sum(g.float().square().sum() for g in on_record), parameters)
        return list(plain), list(second)

    fast = derivatives()
    monkeypatch.setattr("mcdenoise.models.unet._ReLU.forward", lambda self, x: torch.relu(x))
    monkeypatch.setattr("mcdenoise.models.unet._Upsampling.forward", torch.nn.ConvTranspose2d.forward)
    for order, found, expected in zip((1, 2), fast, derivatives(), strict=True):
        for (name, _), a, b in zip(net.named_parameters(), found, expected, strict=True):
            if order == 1 and not (name.startswith("up") and name.endswith("bias")):
                assert torch.equal(a, b), name
            else:
                # Another order of summation, and what follows from it.
                assert (a - b).abs().max() <= 4 * torch.finfo(torch.bfloat16).eps * b.abs().max(), name


@pytest.mark.parametrize("name", list_models())
def test_a_gradient_reaches_every_parameter(name: str) -> None:
    model = build(name)
    color, *features = inputs(24, 24)
    initial, final = model(color, *features)
    ((initial - 1).square().mean() + (final - 1).square().mean()).backward()
    for key, parameter in model.named_parameters():
        assert parameter.grad is not None, key
        assert torch.isfinite(parameter.grad).all(), key
        assert parameter.grad.abs().max() > 0, key


@pytest.mark.parametrize("name", list_models())
def test_images_of_a_batch_do_not_see_each_other(name: str) -> None:
    model = build(name)
    color, *features = inputs(17, 20, batch=2)
    color[1] *= 1000
    with torch.no_grad():
        together = model(color, *features).final
        alone = [model(color[i : i + 1], *(x[i : i + 1] for x in features)).final for i in (0, 1)]
    # 2e-6 was measured: another batch size may sum in another order.
    torch.testing.assert_close(together, torch.cat(alone), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("factor", [1e-3, 1e-1, 1e3])
@pytest.mark.parametrize("name", list_models())
def test_exposure_only_scales_the_result(name: str, factor: float) -> None:
    model = build(name)
    color, *features = inputs(33, 20)
    with torch.no_grad():
        result, scaled = model(color, *features).final, model(color * factor, *features).final
    torch.testing.assert_close(scaled / factor, result, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
@pytest.mark.parametrize("name", list_models())
def test_the_unit_of_the_scene_does_not_matter(name: str, factor: float) -> None:
    model = build(name)
    color, albedo, normal, depth = inputs(17, 20)
    with torch.no_grad():
        result, scaled = (model(color, albedo, normal, d).final for d in (depth, depth * factor))
    torch.testing.assert_close(scaled, result, rtol=1e-4, atol=1e-5)


def test_auto_exposure_brings_a_constant_image_to_the_key() -> None:
    color = torch.full((1, 3, 20, 20), 8.0)
    torch.testing.assert_close(auto_exposure(color, key=0.5), torch.full((1, 1, 1, 1), 0.0625))
    assert auto_exposure(torch.zeros(2, 3, 5, 5)).flatten().tolist() == [1, 1]


def test_normalized_depth_written_out() -> None:
    # The geometric mean of 1 and 4 is 2.
    depth = torch.tensor([1.0, 4.0, torch.inf]).reshape(1, 1, 1, 3)
    torch.testing.assert_close(normalize_depth(depth).flatten(), torch.tensor([1 / 3, 2 / 3, 1.0]))
    assert normalize_depth(torch.full((1, 1, 2, 2), torch.inf)).unique().tolist() == [1]


def test_without_a_history_a_frame_is_all_there_is() -> None:
    model, shape = build("cascaded"), (1, 3, 13, 18)
    for weight in model.parameters():
        nn.init.normal_(weight, std=0.1)
    inputs = [torch.rand(shape), torch.rand(shape), torch.rand(shape) * 2 - 1, torch.rand(1, 1, 13, 18)]
    length = torch.ones(1, 1, 13, 18)
    with torch.no_grad():
        alone = model(*inputs).final
        assert torch.equal(model(*inputs, inputs[0], length).final, alone)
        assert not torch.allclose(model(*inputs, inputs[0] * 2, length).final, alone, rtol=1e-3)
        assert not torch.allclose(model(*inputs, inputs[0], length * 4).final, alone, rtol=1e-3)


@pytest.mark.parametrize("bilateral", [True, False])
def test_kernels_keep_a_constant_image(bilateral: bool) -> None:
    torch.manual_seed(0)
    predictor = KernelPredictor(WIDTH, bilateral=bilateral)
    features = torch.rand(1, FEATURES, 13, 18)
    with torch.no_grad():
        image = predictor(torch.full((1, 3, 13, 18), 0.7), features)
    torch.testing.assert_close(image, torch.full_like(image, 0.7), rtol=0, atol=1e-5)


@pytest.mark.parametrize("bilateral", [True, False])
def test_filtered_pixels_lie_between_those_of_the_input(bilateral: bool) -> None:
    torch.manual_seed(0)
    predictor = KernelPredictor(WIDTH, bilateral=bilateral)
    # With alpha = 0 the fusion keeps the finest scale: what is left are weighted means of the input.
    for fusion in predictor.fusions:
        nn.init.zeros_(fusion.conv.weight)
        nn.init.constant_(fusion.conv.bias, -1e4)
    image = torch.rand(1, 3, 13, 18) + 0.5
    with torch.no_grad():
        filtered = predictor(image, torch.full((1, FEATURES, 13, 18), 0.5))
    low, high = image.amin((2, 3), keepdim=True), image.amax((2, 3), keepdim=True)
    assert (filtered >= low - 1e-5).all()
    assert (filtered <= high + 1e-5).all()
    assert filtered.std() < image.std()


def test_a_pixel_network_at_rest_keeps_a_constant_image_and_never_outshines_its_input() -> None:
    torch.manual_seed(0)
    predictor = PixelPredictor(WIDTH)
    features = torch.rand(1, FEATURES, 13, 18)
    constant = torch.full((1, 3, 13, 18), 0.7)
    image = torch.rand(1, 3, 13, 18)
    with torch.no_grad():
        torch.testing.assert_close(predictor(constant, features), constant, rtol=0, atol=1e-5)
        for head in predictor.heads:
            nn.init.constant_(head.bias, 100.0)
        assert predictor(image, features).max() <= image.max() + 1e-5


def test_the_kernel_heads_are_those_of_the_paper() -> None:
    model = create_model("cascaded")
    heads = model.second.heads
    assert [head.out_channels for head in heads] == [28, 28, 28]
    assert [head.out_channels for head in model.first.heads] == [3, 3, 3]
    assert {head.in_channels for head in [*heads, *model.first.heads]} == {40}
    assert {create_model(name).first.heads[0].in_channels for name in ("pixel", "kernel")} == {64}
    assert [head.out_channels for head in create_model("kernel_plain", kernel_size=3).first.heads] == [9, 9, 9]


@pytest.mark.parametrize(
    ("name", "widths", "taps"),
    [
        ("cascaded", (40, 40), 25),
        ("cascaded_small", (16, 32), 25),
        ("cascaded_tiny", (16, 16), 9),
        ("cascaded_micro", (16, 16), 9),
    ],
)
def test_the_sizes_of_the_cascade(name: str, widths: tuple[int, int], taps: int) -> None:
    model = create_model(name)
    assert tuple(part.heads[0].in_channels for part in (model.first, model.second)) == widths
    # Of half the resolution, a feature stands for two by two pixels.
    finest = 4 if name == "cascaded_micro" else 1
    assert [head.out_channels for head in model.second.heads] == [finest * (taps + 3), taps + 3, taps + 3]


def test_the_width_of_the_kernel_network_can_be_set() -> None:
    def widths(**settings: Any) -> tuple[int, int]:
        model = create_model(**settings)
        return model.first.heads[0].in_channels, model.second.heads[0].in_channels

    assert widths(name="cascaded", width=8) == (8, 8)
    assert widths(name="cascaded", width=8, kernel_width=12) == (8, 12)
    # In K+P the kernel network comes first.
    assert widths(name="kernel_pixel", width=8, kernel_width=12) == (12, 8)
    assert widths(name="cascaded_small", width=8) == (8, 32)
    assert widths(name="cascaded_small", width=8, kernel_width=None) == (8, 8)


@pytest.mark.parametrize(("levels", "half"), [(4, False), (5, False), (3, True), (4, True)])
def test_unet_gives_three_scales_of_any_size(levels: int, half: bool) -> None:
    unet = UNet(5, 4, levels, coarse_width=6, half=half)
    for height, width in ((1, 1), (7, 9), (16, 32)):
        features = unet(torch.rand(2, 5, height, width))
        sizes = [(-(-height // s), -(-width // s)) for s in ((2, 2, 4) if half else (1, 2, 4))]
        widths = (4, 4, 6) if half else (4, 6, 6)
        assert [tuple(f.shape) for f in features] == [(2, w, *size) for w, size in zip(widths, sizes, strict=True)]
        sizes = [(-(-height // s), -(-width // s)) for s in (1, 2, 4)]
        for scale, (feature, size) in enumerate(zip(features, sizes, strict=True)):
            assert Head(unet, scale, 3)(feature, size).shape == (2, 3, *size)


def test_a_head_predicts_the_pixels_that_a_feature_of_half_the_resolution_stands_for() -> None:
    unet = UNet(1, 2, 3, half=True)
    head = Head(unet, 0, 1)
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.zero_()
        # The middle of the kernel: each of two by two pixels is a multiple of the first feature.
        head.weight[:, 0, 1, 1] = torch.tensor([1.0, 2.0, 3.0, 4.0])
    predicted = head(torch.tensor([[[[1.0, 10.0]], [[7.0, 7.0]]]]), (2, 3))
    assert predicted.tolist() == [[[[1, 2, 10], [3, 4, 30]]]]


def test_unet_sees_what_it_is_given_at_coarser_scales() -> None:
    torch.manual_seed(0)
    unet = UNet(5, 4, coarse_channels=2)
    image = torch.rand(1, 5, 13, 22)
    coarse = [torch.rand(1, 2, *size, requires_grad=True) for size in ((7, 11), (4, 6), (2, 3))]
    features = unet(image, coarse)
    assert [tuple(f.shape[-2:]) for f in features] == [(13, 22), (7, 11), (4, 6)]
    for gradient in torch.autograd.grad(features[0].sum(), coarse):
        assert gradient.abs().sum() > 0


def test_a_pixel_network_is_given_the_means_of_its_image_at_coarser_scales() -> None:
    model = build("pixel")
    given: list[list[torch.Tensor]] = []
    model.first.unet.register_forward_pre_hook(lambda _, arguments: given.append(arguments[1]))
    color, albedo, normal, depth = inputs(13, 22)
    model(color, albedo, normal, depth)
    image = color * auto_exposure(color)
    for scale, mean in zip((2, 4, 8), given[0], strict=True):
        expected = image.unfold(2, scale, scale).unfold(3, scale, scale).mean((-2, -1))
        whole = (slice(None), slice(None), slice(13 // scale), slice(22 // scale))
        torch.testing.assert_close(mean[whole], torch.log1p(expected))


@pytest.mark.parametrize(("levels", "half", "lowest"), [(0, False, 4), (2, False, 4), (3, False, 4), (2, True, 3)])
def test_unet_needs_a_decoder_level_for_each_scale(levels: int, half: bool, lowest: int) -> None:
    with pytest.raises(ValueError, match=f"levels: expected at least {lowest}, found {levels}"):
        UNet(5, 4, levels, half=half)


# Parts of an image


def half_known(name: str, top: int, left: int) -> tuple[Cascade, tuple[Tensor, ...], Known]:
    """A cascade, its inputs, and a result that is known but for 60 x 70 pixels."""
    model = build(name).to(memory_format=torch.channels_last)
    assert isinstance(model, Cascade)
    frame = inputs(237, 331)
    mask = torch.ones(1, 1, 237, 331, dtype=torch.bool)
    mask[..., top : top + 60, left : left + 70] = False
    return model, frame, Known(mask, frame[0] * 0.7, frame[0] * 0.6)


@pytest.mark.parametrize("name", ["cascaded", "cascaded_tiny", "cascaded_micro", "kernel_pixel", "kernel", "pixel"])
@pytest.mark.parametrize(("top", "left"), [(0, 0), (100, 131), (170, 250)])
@torch.inference_mode()
def test_a_part_of_an_image_is_that_of_the_whole(name: str, top: int, left: int) -> None:
    model, frame, known = half_known(name, top, left)
    parts = model.parts(known.mask)
    assert sum(part.grown(model.halo, (237, 331)).pixels for part in parts) < 0.8 * 237 * 331
    whole, part = model(*frame, known=known), model(*frame, known=known, parts=parts)
    for a, b, given in zip(whole, part, (known.initial, known.final), strict=True):
        # Convolutions choose the order of their sums by the size of the image and the number of threads.
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5 * float(a.mean()))
        assert torch.equal(torch.where(known.mask, b, given), given)
    assert not torch.equal(whole.initial, known.initial)


@torch.inference_mode()
def test_a_part_needs_all_around_it_that_the_network_sees(monkeypatch: pytest.MonkeyPatch) -> None:
    model, frame, known = half_known("cascaded", 100, 131)
    parts, whole = model.parts(known.mask), model(*frame, known=known)
    monkeypatch.setattr(Cascade, "halo", 24)
    off = (model(*frame, known=known, parts=parts).final - whole.final).abs().max()
    assert off > 1e-3 * whole.final.mean()


@torch.inference_mode()
def test_what_is_known_is_not_computed() -> None:
    model, frame, known = half_known("cascaded", 0, 0)
    everything = known._replace(mask=torch.ones_like(known.mask))
    assert model.parts(everything.mask) == []
    model.first.register_forward_hook(lambda *_: pytest.fail("the network ran"))
    results = model(*frame, known=everything, parts=[])
    assert torch.equal(results.initial, known.initial)
    assert torch.equal(results.final, known.final)


def distance(results: Denoised, expected: Denoised) -> float:
    """Of the largest difference, in means of the image."""
    pairs = zip(results, expected, strict=True)
    return max(float((result - image).abs().max() / image.mean()) for result, image in pairs)


@pytest.mark.parametrize("side", [32, 96, 128])
@pytest.mark.parametrize("name", ["cascaded", "cascaded_tiny", "cascaded_micro", "kernel"])
@torch.inference_mode()
def test_tiles_are_the_whole_image(name: str, side: int, monkeypatch: pytest.MonkeyPatch) -> None:
    model, frame, known = half_known(name, 100, 131)
    tiles = Region(0, 0, 237, 331).split(side)
    # Measured at most 1.1e-6: convolutions of small images are summed in another order.
    assert distance(model(*frame, parts=tiles), model(*frame)) < 3e-6
    tiles = [tile for part in model.parts(known.mask) for tile in part.split(side)]
    assert distance(model(*frame, known=known, parts=tiles), model(*frame, known=known)) < 3e-6
    monkeypatch.setattr(Cascade, "halo", 24)
    assert distance(model(*frame, parts=Region(0, 0, 237, 331).split(side)), model(*frame)) > 1e-3


@torch.inference_mode()
def test_lower_resolutions_see_further() -> None:
    """Of what is 70 pixels away half the resolution knows, of what is 150 away a quarter of it."""
    model, frame = build("cascaded"), inputs(64, 640)
    assert isinstance(model, Cascade)
    for distance, resolutions in ((70, 2), (150, 3)):
        color, albedo, *others = frame
        # On which the exposure does not depend.
        albedo = albedo.clone()
        albedo[..., distance : distance + 16] = 1 - albedo[..., distance : distance + 16]
        changes = []
        for model.resolutions in (resolutions - 1, resolutions):
            change = model(color, albedo, *others).initial - model(*frame).initial
            changes.append(float(change[..., 0].abs().max()))
        assert changes[0] == 0 < changes[1]


def test_low_frequencies_are_those_of_the_coarse_image() -> None:
    fine, coarse = 0.5 + torch.rand(2, 3, 40, 48, dtype=torch.float64), torch.full((2, 3, 20, 24), 3.0).double()
    # Every block has the same mean, so that nothing is interpolated.
    fine[..., 8:, :] = fine[..., :8, :].repeat(1, 1, 4, 1)
    fine[..., 8:] = fine[..., :8].repeat(1, 1, 1, 5)
    result = low_frequencies_of(fine, coarse, torch.full((2, 1, 1, 1), 9.0).double())
    mean = fine[..., :8, :8].mean((-2, -1), keepdim=True)
    torch.testing.assert_close(result, fine * (3 + 1e-3) / (mean + 1e-3), rtol=1e-12, atol=0)


@pytest.mark.parametrize("size", [(40, 48), (37, 51), (1, 9), (8, 1)])
def test_low_frequencies_of_its_own_change_nothing(size: tuple[int, int]) -> None:
    fine = torch.rand(1, 3, *size, dtype=torch.float64)
    result = low_frequencies_of(fine, downsample(fine), torch.log1p(fine.amax((1, 2, 3), keepdim=True)))
    torch.testing.assert_close(result, fine, rtol=1e-12, atol=0)


def test_low_frequencies_of_a_lamp_stay_off_the_wall_beside_it() -> None:
    """The lamp grows by a tenth; the wall, a millionth of it, does not grow by a tenth of the lamp."""
    fine = torch.full((1, 3, 32, 32), 1e-2, dtype=torch.float64)
    fine[..., 8:16, 8:16] = 1e4
    coarse = downsample(fine)
    coarse[..., 4:8, 4:8] *= 1.1
    result = low_frequencies_of(fine, coarse, torch.full((1, 1, 1, 1), 9.0).double())
    lamp = torch.zeros(32, 32, dtype=torch.bool)
    lamp[8:16, 8:16] = True
    assert result[..., lamp].unique().tolist() == [pytest.approx(np.expm1(9.0))]
    assert result[..., ~lamp].min() > 1e-2 * (1 - 1e-9)
    assert result[..., ~lamp].max() < 1.1e-2 * (1 + 1e-9)


def test_low_frequencies_are_differentiable() -> None:
    fine, coarse = (torch.rand(1, 1, side, 9 if side > 5 else 5, dtype=torch.float64) + 0.1 for side in (10, 5))
    top = torch.full((1, 1, 1, 1), 5.0, dtype=torch.float64)
    arguments = (fine.requires_grad_(), coarse.requires_grad_())
    assert torch.autograd.gradcheck(lambda *images: low_frequencies_of(*images, top), arguments)
    assert torch.autograd.gradgradcheck(lambda *images: low_frequencies_of(*images, top), arguments)


def test_halves_of_parts_hold_what_they_depend_on() -> None:
    size = (237, 331)
    assert halved([], 8, size) == []
    assert halved([Region(0, 0, *size)], 8, size) == [Region(0, 0, 119, 166)]
    for parts in (
        [Region(32, 64, 64, 96)],
        [Region(0, 96, 32, 128), Region(192, 320, 237, 331)],
        Region(0, 0, *size).split(64),
    ):
        found = halved(parts, 8, size)
        covered = torch.zeros(119, 166)
        for region in found:
            assert all(start % 32 == 0 for start in region[:2])
            assert max(region.bottom - region.top, region.right - region.left) <= 64
            region.of(covered).add_(1)
        assert covered.max() == 1
        for part in parts:
            assert part.grown(8, size).halved().of(covered).min() == 1


def test_tiles_hold_every_pixel_once() -> None:
    for region, side in ((Region(0, 0, 237, 331), 96), (Region(64, 32, 65, 4000), 1024), (Region(0, 0, 64, 64), 64)):
        count = torch.zeros(region.bottom, region.right)
        tiles = region.split(side)
        for tile in tiles:
            assert max(tile.bottom - tile.top, tile.right - tile.left) <= side
            assert all(start % 32 == 0 for start in tile[:2])
            tile.of(count).add_(1)
        assert region.of(count).min() == count.max() == 1
        assert count.sum() == region.pixels
    # No sliver is left over.
    assert [tile.right - tile.left for tile in Region(0, 0, 32, 1056).split(1024)] == [544, 512]


def test_rectangles_hold_what_is_needed_once_and_reach_no_other() -> None:
    needed = torch.zeros(2, 1, 1000, 1400, dtype=torch.bool)
    for image, top, left in ((0, 3, 5), (0, 40, 70), (1, 500, 900), (0, 999, 1399)):
        needed[image, 0, top, left] = True
    boxes = regions(needed, 64)
    assert boxes == [Region(0, 0, 64, 96), Region(480, 896, 512, 928), Region(992, 1376, 1000, 1400)]
    covered = sum(box.of(needed).sum() for box in boxes)
    assert covered == needed.sum()


def test_where_a_part_costs_as_much_as_the_whole_it_is_the_whole() -> None:
    needed = torch.zeros(1, 1, 90, 160, dtype=torch.bool)
    assert regions(needed, 64) == []
    needed[..., 40, 80] = True
    assert regions(needed, 64) == [Region(0, 0, 90, 160)]
    assert regions(needed, 8) == [Region(32, 64, 64, 96)]


@pytest.mark.parametrize("name", ["cascaded", "kernel_kernel"])
@pytest.mark.parametrize("size", [(33, 47), (96, 110)])
@torch.inference_mode()
def test_a_constant_guide_guides_nothing(name: str, size: tuple[int, int]) -> None:
    color, albedo, normal, _ = inputs(*size)
    for constant, guides in (
        ((normal[..., :1, :1].expand_as(normal), torch.full((1, 1, *size), 3.7)), ()),
        ((normal, torch.full((1, 1, *size), torch.inf)), ("normal",)),
        ((torch.zeros_like(normal), 1 + inputs(*size)[3]), ("depth",)),
    ):
        model = build(name)
        expected, result = model(color, albedo, *constant), model(color, albedo, *constant, guides=guides)
        assert all(torch.equal(a, b) for a, b in zip(expected, result, strict=True))
    other = model(color, albedo, normal, constant[1], guides=())
    assert not torch.equal(other.final, model(color, albedo, normal, constant[1]).final)


def test_large_images_have_the_derivatives_of_the_plain_form() -> None:
    """Large enough for compiled forms, some of which have no derivatives."""
    gradients = []
    for backend in ("torch", "numba"):
        torch.manual_seed(0)
        model = create_model("cascaded", width=8)
        for head in model.first.heads:
            nn.init.normal_(head.weight, std=0.1)
        with preferred(backend):
            model(*inputs(96, 110)).final.mean().backward()
        gradients.append([parameter.grad for parameter in model.parameters()])
    for fast, plain in zip(*gradients, strict=True):
        torch.testing.assert_close(fast, plain, rtol=1e-3, atol=1e-6)


def test_golden() -> None:
    # Changes only together with the architecture or an initialisation, and then every file of weights is void.
    # The snippet that made the numbers:
    #   torch.manual_seed(0)
    #   model = create_model("cascaded", width=8)
    #   grid = torch.linspace(0, 1, 8 * 9).reshape(1, 1, 8, 9)
    #   color = torch.cat([grid, 1 - grid, (7 * grid) % 1], 1)
    #   initial, final = model(color, color.flip(1), color * 2 - 1, 1 + grid)
    #   print(initial[0, :, 4, ::4], final[0, :, 4, ::4])
    torch.manual_seed(0)
    model = create_model("cascaded", width=8)
    grid = torch.linspace(0, 1, 8 * 9).reshape(1, 1, 8, 9)
    color = torch.cat([grid, 1 - grid, (7 * grid) % 1], 1)
    with torch.no_grad():
        initial, final = model(color, color.flip(1), color * 2 - 1, 1 + grid)
    expected_initial = [[0.507042, 0.563380, 0.619718], [0.492958, 0.436620, 0.380282], [0.549296, 0.943662, 0.338028]]
    expected_final = [[0.518438, 0.589259, 0.615392], [0.483208, 0.415058, 0.387318], [0.602152, 0.873555, 0.313576]]
    torch.testing.assert_close(initial[0, :, 4, ::4], torch.tensor(expected_initial), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(final[0, :, 4, ::4], torch.tensor(expected_final), rtol=1e-4, atol=1e-5)


# Saving and loading


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    path = tmp_path / "small.safetensors"
    path.write_bytes(save_weights(build("cascaded"), "cascaded", {"width": WIDTH}, {"steps": "7", "licence": "none"}))
    return path


def altered(weights: Path, change: Callable[[dict[str, Tensor], dict[str, str]], object]) -> Path:
    """The file with other tensors or another header."""
    tensors = load_file(weights)
    about = describe_weights(weights)
    header = {key: value if isinstance(value, str) else json.dumps(value) for key, value in about.items()}
    change(tensors, header)
    save_file(tensors, weights, header)
    return weights


def test_saved_and_loaded_in_half_precision(weights: Path) -> None:
    saved, loaded = build("cascaded"), create_model("cascaded", weights=weights)
    assert not loaded.training
    assert {tensor.dtype for tensor in load_file(weights).values()} == {torch.float16}
    for (key, before), (same_key, after) in zip(saved.state_dict().items(), loaded.state_dict().items(), strict=True):
        assert key == same_key
        assert after.dtype == torch.float32
        assert torch.equal(after, before.half().float())
    with torch.no_grad():
        before, after = (model(*inputs(17, 20)).final for model in (saved, loaded))
    # 6e-4 of values up to 2 was measured.
    torch.testing.assert_close(after, before, rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("cascaded_small", {}),
        ("cascaded_small", {"width": WIDTH, "kernel_width": 12}),
        ("cascaded_tiny", {}),
        ("cascaded_tiny", {"width": WIDTH, "kernel_size": 5}),
    ],
)
def test_settings_are_saved_and_loaded(name: str, settings: dict[str, int], tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    torch.manual_seed(0)
    model = create_model(name, **settings)
    path.write_bytes(save_weights(model, name, settings, {}))
    assert describe_weights(path)["settings"] == settings
    for loaded in (load_weights(path), create_model(name, weights=path)):
        state = loaded.state_dict()
        assert list(state) == list(model.state_dict())
        assert all(torch.equal(state[key], value.half().float()) for key, value in model.state_dict().items())


def test_the_header_describes_the_weights(weights: Path) -> None:
    about = describe_weights(weights)
    digest = hashlib.sha256()
    for key, tensor in sorted(load_file(weights).items()):
        digest.update(key.encode() + tensor.numpy().tobytes())
    assert about == {
        "architecture": "cascaded",
        "settings": {"width": WIDTH},
        "steps": "7",
        "licence": "none",
        "sha256": digest.hexdigest(),
    }


def test_weights_of_another_model_are_refused(weights: Path) -> None:
    message = refused(lambda: create_model("pixel", weights=weights))
    assert "expected weights of model 'pixel', found those of 'cascaded'" in message


def test_a_missing_layer_is_named(weights: Path) -> None:
    path = altered(weights, lambda tensors, header: tensors.pop("first.heads.0.weight"))
    message = refused(lambda: load_weights(path))
    assert "layer 'first.heads.0.weight': model 'cascaded' expects (3, 8, 3, 3), found no such layer" in message


def test_an_unknown_layer_is_named(weights: Path) -> None:
    path = altered(weights, lambda tensors, header: tensors.update(third=torch.zeros(2)))
    assert "layer 'third': model 'cascaded' expects no such layer, found (2,)" in refused(lambda: load_weights(path))


def test_a_layer_of_another_shape_is_named(weights: Path) -> None:
    message = refused(lambda: load_weights(weights, width=6))
    assert "layer 'first.heads.0.weight': model 'cascaded' expects (3, 6, 3, 3), found (3, 8, 3, 3)" in message


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("architecture", "other", "model 'other': expected one of"),
        ("settings", "{", "header 'settings': expected a JSON object"),
        ("settings", "[1]", "header 'settings': expected a JSON object"),
        ("settings", '{"colour": 1}', "expected settings of model 'cascaded', found {'colour': 1}"),
        ("settings", '{"width": -1}', "expected settings of model 'cascaded', found {'width': -1}"),
    ],
)
def test_a_header_that_means_nothing_is_refused(weights: Path, key: str, value: str, expected: str) -> None:
    path = altered(weights, lambda tensors, header: header.update({key: value}))
    assert expected in refused(lambda: load_weights(path))


def test_files_that_are_no_weights_are_refused(weights: Path, tmp_path: Path) -> None:
    whole = weights.read_bytes()
    for content in (b"", b"a text, and no tensors", whole[:-100], whole[:100]):
        weights.write_bytes(content)
        assert str(weights) in refused(lambda: load_weights(weights))
    save_file({"layer": torch.zeros(1)}, weights)
    assert "found no 'architecture' in the header" in refused(lambda: load_weights(weights))
    assert "No such file" in refused(lambda: load_weights(tmp_path / "nothing"))
    refused(lambda: load_weights(tmp_path))


def test_a_model_without_shipped_weights_says_so() -> None:
    for name in set(list_models()) - set(pretrained_models()):
        message = refused(lambda name=name: create_model(name, pretrained=True))
        assert f"model '{name}': expected shipped weights" in message
    assert "expected one of" in refused(lambda: create_model("oidn", pretrained=True))


def test_a_damaged_tensor_and_an_infinite_weight_are_refused(tmp_path: Path) -> None:
    model, path = create_model("cascaded", width=4), tmp_path / "cascaded.safetensors"
    content = bytearray(save_weights(model, "cascaded", {"width": 4}, {}))
    path.write_bytes(content)
    load_weights(path)
    content[-1] ^= 1
    path.write_bytes(content)
    assert "sha256" in refused(lambda: load_weights(path))
    with torch.no_grad():
        next(model.parameters()).flatten()[0] = 1e6  # more than half precision holds
    assert "NaN or infinite" in refused(lambda: save_weights(model, "cascaded", {"width": 4}, {}))


def test_the_cascades_have_weights() -> None:
    assert pretrained_models() == ["cascaded", "cascaded_micro", "cascaded_small", "cascaded_tiny"]


@pytest.mark.parametrize("name", pretrained_models())
def test_the_shipped_weights(name: str) -> None:
    model = create_model(name, pretrained=True)
    about = describe_weights(SHIPPED / f"{name}.safetensors")
    assert about["licence"] == "Apache-2.0"
    for author in ("Mareck", "NovaZeeke", "Jay-Artist", "Wig42"):
        assert author in about["credits"]
    assert int(about["steps"]) == json.loads(about["config"])["steps"]
    assert all(len(part["commit"]) == 40 for part in json.loads(about["commits"]))
    # Flythroughs and zoomed shots are of the same scenes.
    trained_on = {re.sub(r"-flythrough$|-z[0-9]$", "", entry["name"]) for entry in json.loads(about["data"])}
    own = {scene for scene in trained_on if re.fullmatch(r"random[0-9]{4}", scene)}
    # Nothing whose licence does not allow it, and nothing that is evaluated on.
    assert trained_on - own == {"bathroom", "classroom", "living-room-2", "staircase"}
    assert not own & {"random9000", "random9002"}
    with torch.no_grad():
        assert torch.isfinite(model(*inputs(33, 20)).final).all()


def test_overview() -> None:
    entries = {entry.name: entry for entry in overview()}
    assert list(entries) == list_models()
    for name, entry in entries.items():
        assert entry.parameters == sum(parameter.numel() for parameter in create_model(name).parameters())
        assert entry.kmacs_per_pixel > 0
        assert entry.description
        assert "\n" not in entry.description
        assert entry.pretrained is (name in pretrained_models())
    cost = {name: entry.kmacs_per_pixel / entries["cascaded"].kmacs_per_pixel for name, entry in entries.items()}
    assert cost["cascaded_small"] == pytest.approx(0.41, abs=0.005)
    assert cost["cascaded_tiny"] == pytest.approx(0.18, abs=0.005)
    assert cost["cascaded_micro"] == pytest.approx(0.08, abs=0.005)


def test_the_cost_of_the_pixel_network_written_out() -> None:
    width = 64
    full = (3 + FEATURES + width) * width * 9
    # At each coarser scale it is given the mean of the image.
    encoder = sum((2 * width + 3) * width * 9 / 4**level for level in (1, 2, 3))
    # A 2x2 transposed convolution, two convolutions of which the first sees the encoder too, and a head.
    decoder = sum((width**2 + 3 * width * width * 9 + 3 * width * 9) / 4**level for level in (0, 1, 2))
    fusions = sum(6 * 9 / 4**level for level in (0, 1))
    cost = next(entry.kmacs_per_pixel for entry in overview() if entry.name == "pixel")
    assert cost == pytest.approx((full + encoder + decoder + fusions) / 1e3, rel=1e-6)
