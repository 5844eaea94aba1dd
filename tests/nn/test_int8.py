"""U-Nets in 8-bit integers, against the same arithmetic written out in float64."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise import Denoiser, Frame
from mcdenoise.cli import main
from mcdenoise.data import open_sequence
from mcdenoise.errors import InputError
from mcdenoise.metrics import smape_linear
from mcdenoise.models import _precision, create_model, describe_weights, load_weights, pretrained_models, save_weights
from mcdenoise.nn import UNet
from mcdenoise.nn.int8 import Convolution, Int8UNet, Stored, has_int8, integers, measure

needs_int8 = pytest.mark.skipif(not has_int8(), reason="the processor has no dot products of 8-bit integers")
SIZES = [(3, 8), (16, 8)]


def stored(scales: list[float], zero: int) -> Stored:
    return Stored(torch.tensor(scales), zero)


def test_values_are_rounded_to_the_nearest_integer_and_clamped() -> None:
    how = stored([0.5, 2.0], 96)
    values = torch.tensor([[-100.0, -48.0, 0.0, 0.24, 0.26, 79.5, 90.0], [-1.1, -0.9, 0.0, 0.9, 1.1, 3.0, 1e9]])
    integers_of = how.store(values[None, :, None])
    expected = [[0, 0, 96, 96, 97, 255, 255], [95, 96, 96, 96, 97, 98, 255]]
    assert integers_of[0, :, 0].tolist() == expected
    # Half a step is the most that is lost within the range.
    error = (how.restore(integers_of)[0, :, 0] - values).abs()
    assert (error[0, 1:6] <= 0.25).all()
    assert (error[1, :6] <= 1).all()


@pytest.mark.parametrize("signed", [False, True])
def test_a_range_fits(signed: bool) -> None:
    ranges = torch.tensor([[-3.0, 4.0], [-1.0, 9.0], [0.0, 0.0]]) if signed else torch.tensor([[0.0, 4.0], [0.0, 0.1]])
    how = Stored.over(ranges, len(ranges), signed=signed)
    restored = how.restore(how.store(ranges.T[:, :, None, None]))[..., 0, 0].T
    torch.testing.assert_close(restored, ranges, rtol=0, atol=float(how.scales.max()) / 2 * (1 + 1e-5))
    assert Stored.over(ranges[:1], 5, signed=signed).scales.shape == (5,)


def written_out(
    q: Tensor, weight: Tensor, bias: Tensor, given: Stored, result: Stored | None, stride: int, relu: bool
) -> Tensor:
    """A convolution of what the integers stand for, by weights of which each output channel has 127 steps: float64."""
    values = (q.double() - given.zero) * given.scales.double().view(-1, 1, 1)
    largest = given.scales.max()
    weight = weight * (given.scales / largest).view(1, -1, 1, 1)
    steps = weight.abs().amax((1, 2, 3), keepdim=True) / 127
    weight = (weight / steps).round().double() * steps.double() / (given.scales / largest).double().view(1, -1, 1, 1)
    y = F.conv2d(values, weight, bias.double(), stride, (weight.shape[-1] - 1) // 2)
    y = y.clamp_min(0) if relu else y
    return y if result is None else y / result.scales[0].double() + result.zero


@needs_int8
@pytest.mark.parametrize(("size", "stride"), [(1, 1), (3, 1), (4, 2)])
@pytest.mark.parametrize("zero", [0, 96])
@pytest.mark.parametrize("values", [False, True])
def test_a_convolution_is_that_of_what_the_integers_stand_for(size: int, stride: int, zero: int, values: bool) -> None:
    g = torch.Generator().manual_seed(7)
    weight, bias = torch.randn(6, 5, size, size, generator=g) / size, torch.randn(6, generator=g)
    q = torch.randint(0, 256, (2, 5, 12, 16), generator=g).to(torch.uint8)
    given, relu = stored([0.01, 0.02, 0.004, 0.01, 0.003], zero), zero == 0
    result = None if values else stored([0.05] * 6, 96 - zero)
    expected = written_out(q, weight, bias, given, result, stride, relu)
    found = Convolution(weight, bias, given, result, stride, relu=relu)(
        q.contiguous(memory_format=torch.channels_last), torch.float32 if values else torch.uint8
    )
    if values:
        torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-5)
        return
    # Rounded to the nearest; single precision moves what lies between two integers by no more than this.
    assert (found.double() - expected.clamp(0, 255)).abs().max() <= 0.5 + 1e-3


def network(half: bool, coarse: int) -> tuple[UNet, Tensor, list[Tensor]]:
    torch.manual_seed(3)
    unet = UNet(4, [6, 8, 8] if half else [6, 6, 8, 8], scales=2, coarse_channels=coarse, half=half).eval()
    x = torch.rand(2, 4, 33, 50)
    first = 4 if half else 2
    count = len(unet.widths) - 1 if coarse else 0
    given = [torch.rand(2, coarse, -(-33 // (first << i)), -(-50 // (first << i))) for i in range(count)]
    return unet, x, given


@needs_int8
@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("coarse", [0, 3])
def test_features_are_those_of_the_network(half: bool, coarse: int) -> None:
    unet, x, given = network(half, coarse)
    for _ in range(2):
        unet.calibrate(x, given)
    unet.quantize()
    with torch.no_grad():
        expected = unet(x, given)
        with integers():
            found = unet(x, given)
        with integers(enabled=False):
            assert all(torch.equal(a, b) for a, b in zip(unet(x, given), expected, strict=True))
    for one, other in zip(found, expected, strict=True):
        assert one.shape == other.shape
        # Each of a dozen convolutions adds noise of a third of a step of 1/160 to 1/255 of its range.
        noise = (one - other).square().mean().sqrt() / other.square().mean().sqrt()
        assert 0 < noise < 0.05
    # With derivatives requested, the network itself runs, so they are available.
    with integers():
        assert all(torch.equal(a, b) for a, b in zip(unet(x, given), unet(x, given), strict=True))
        assert unet(x.requires_grad_(), given)[0].requires_grad


@needs_int8
def test_ranges_of_another_network_are_refused() -> None:
    unet, x, given = network(False, 3)
    with pytest.raises(ValueError, match="expected a calibrated U-Net"):
        unet.quantize()
    unet.calibrate(x, given)
    assert unet.ranges is not None
    with pytest.raises(ValueError, match=r"ranges: .*\(29, 2\)"):
        Int8UNet(unet.encoder, unet.up, unet.decoder, unet.ranges[1:])


def test_ranges_hold_what_is_seen() -> None:
    unet, x, given = network(False, 0)
    with torch.no_grad():
        found = measure(unet.encoder, unet.up, unet.decoder, x[..., :32, :48], given)
    assert torch.equal(found[:4, 1], x[..., :32, :48].amax((0, 2, 3)))
    assert (found[:, 0] <= 0).all()
    unet.calibrate(x, given)
    first = unet.ranges
    unet.calibrate(-2 * x, given)
    assert first is not None
    assert unet.ranges is not None
    torch.testing.assert_close(unet.ranges[:4], torch.stack([-2 * x.amax((0, 2, 3)), x.amax((0, 2, 3))], 1))
    assert (unet.ranges[:, 0] <= first[:, 0]).all()
    assert (unet.ranges[:, 1] >= first[:, 1]).all()


def test_calibrated_weights_are_kept(small_sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain, path = tmp_path / "plain.safetensors", tmp_path / "calibrated.safetensors"
    model = create_model("cascaded_v2_micro", pretrained=True)
    for module in model.modules():
        if isinstance(module, UNet):
            module.ranges = None
    plain.write_bytes(save_weights(model, "cascaded_v2_micro", {}, {"licence": "Apache-2.0"}))
    with pytest.raises(SystemExit) as stop:
        main(["calibrate", str(plain), str(small_sequence), "-o", str(path)])
    assert stop.value.code == 0
    assert "calibrated on" in capsys.readouterr().out
    assert describe_weights(path)["licence"] == "Apache-2.0"
    before, after = load_weights(plain), load_weights(path)
    assert isinstance(before, nn.Module)
    assert isinstance(after, nn.Module)
    assert all(torch.equal(a, b) for a, b in zip(before.parameters(), after.parameters(), strict=True))
    assert all(module.ranges is not None for module in after.modules() if isinstance(module, UNet))
    with pytest.raises(InputError, match="found one that is not" if has_int8() else "VNNI"):
        Denoiser("cascaded_v2_micro", weights=plain, precision="int8")


@needs_int8
def test_an_image_in_integers_is_nearly_that_of_floats(small_sequence: Path) -> None:
    whole, rounded = Denoiser("cascaded_v2_micro", precision="float32"), Denoiser("cascaded_v2_micro", precision="int8")
    sequence = open_sequence(small_sequence)
    for number in sequence.numbers:
        frame = sequence.frame(number)
        # On a shot of an interior at 320x180, 0.0047 at most.
        assert float(smape_linear(rounded(frame), whole(frame))) < 0.02
    assert rounded.precision == "int8"


@needs_int8
@pytest.mark.parametrize("name", [name for name in pretrained_models() if name.startswith("cascaded_v2")])
def test_shipped_weights_are_calibrated(name: str) -> None:
    frame = Frame(color=torch.rand(1, 3, 40, 48), albedo=torch.rand(1, 3, 40, 48))
    image = Denoiser(name, precision="int8")(frame)
    assert image.isfinite().all()
    assert torch.equal(image, Denoiser(name, precision="int8")(frame))


def test_a_processor_without_dot_products_is_told_what_to_take(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_precision, "has_int8", lambda: False)
    with pytest.raises(InputError, match=r"dot products of 8-bit integers \(VNNI\) .*, found none; take bfloat16"):
        Denoiser("cascaded_v2_micro", precision="int8")


def test_methods_that_integers_cannot_compute_are_refused() -> None:
    for settings, message in (
        ({"model": "svgf"}, "without a U-Net" if has_int8() else "VNNI"),
        ({"model": "cascaded_v2_micro", "differentiable": True}, "expected float32 or bfloat16 with differentiable"),
    ):
        with pytest.raises(InputError, match=message):
            Denoiser(**settings, precision="int8")  # type: ignore[arg-type]
