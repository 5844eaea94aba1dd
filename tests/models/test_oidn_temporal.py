"""Open Image Denoise with histories and a network behind it: what it gives untrained, and what it can learn to give."""

from __future__ import annotations

import copy
import importlib.util
import math
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree
from toys import frame_of, refused, small, whole_frame

from mcdenoise import Denoiser, Frame
from mcdenoise.data import open_sequence
from mcdenoise.errors import InputError
from mcdenoise.frame import Hints
from mcdenoise.metrics import smape_linear
from mcdenoise.models import Accumulated, Demodulated, build_model, create_model, parts_of, pretrained_models
from mcdenoise.models.noisy import Noisy
from mcdenoise.models.oidn import Oidn
from mcdenoise.models.oidn_temporal import NOISY, NOISY_CURRENT, AfterOidn, RepairNetwork, has_exact_features
from mcdenoise.train.cache import open_cached
from mcdenoise.train.clips import Clip
from mcdenoise.train.front import split
from mcdenoise.train.losses import display_error
from mcdenoise.train.unroll import unroll

if importlib.util.find_spec("pyoidn") is None:
    pytest.skip("Open Image Denoise is in the extra mcdenoise[oidn]", allow_module_level=True)

NAME = "oidn_temporal"


def oidn_of(frame: Frame, auxiliary: Any = "noisy") -> Tensor:
    return Oidn("high", auxiliary, threads=1)(frame)[0].image


def forced(**values: float) -> RepairNetwork:
    """A network that predicts the same everywhere: kernels of one tap, and what is named."""
    network = RepairNetwork((8, 8))
    order = ("importance", "history", "noisy history", "repair", "gain")
    with torch.no_grad():
        for scale, head in enumerate(network.heads):
            assert not head.weight.any()
            bias = torch.zeros(len(head.bias) // (1 if scale else 4))
            bias[4] = 100
            if not scale:
                # What the finest scale keeps.
                bias[9] = values.get("keep", 0)
                bias[11:] = torch.tensor([values.get(name.replace(" ", "_"), 0.0) for name in order])
            head.bias.copy_(bias if scale else bias.repeat_interleave(4))
    return network


def given(height: int = 21, width: int = 34) -> Frame:
    """What the network sees: two images of OIDN's and two noisy ones, all different."""
    images = {name: torch.rand(1, 3, height, width) + 0.1 for name in (NOISY, NOISY_CURRENT)}
    length = torch.full((1, 1, height, width), 3.0)
    return frame_of(height, width, current=torch.rand(1, 3, height, width), length=length, extra=images)


def test_untrained_it_is_oidn_half_and_half_with_its_history() -> None:
    """Up to what is put back at rest: less than a fiftieth of the largest difference between the samples and OIDN."""
    denoiser = Denoiser(build_model(NAME, threads=1, auxiliary="noisy"))
    history = Denoiser(Demodulated(Accumulated(Noisy(), lag_threshold=math.inf, firefly_limit=math.inf)))
    samples = Denoiser(Demodulated(Accumulated(Noisy(), lag_threshold=math.inf, firefly_limit=math.inf)))
    for seed in range(3):
        frame = whole_frame(denoiser.model, 24, 40, seed=seed)
        now = oidn_of(frame)
        before = history(frame.replace(color=now))
        expected = (now + before) / 2
        output = denoiser.output(frame)
        torch.testing.assert_close(output.stages["oidn"], now, rtol=1e-4, atol=1e-5)
        # Both without albedo, the least of which is 0.2.
        largest = float((samples(frame) - expected).abs().max()) / 0.2
        assert (output.image - expected).abs().max() <= largest / 50
        assert not torch.equal(output.image, now)


def test_it_can_give_each_of_what_it_weighs() -> None:
    frame, high, low = given(), 100.0, -100.0
    by_name = {
        "color": {"history": high, "repair": low},
        "current": {"history": low, "repair": low},
        NOISY: {"noisy_history": high, "repair": high, "keep": high},
        NOISY_CURRENT: {"noisy_history": low, "repair": high, "keep": high},
    }
    for name, values in by_name.items():
        image = forced(**values)(frame)[0].image
        # A thousandth of the light of each pixel is handed on to coarser scales.
        torch.testing.assert_close(image, frame.buffer(name), rtol=5e-3, atol=5e-3)


def test_what_is_put_back_at_coarse_scales_is_a_mean() -> None:
    """Noise around a bias of OIDN's: handed on to coarser scales, the noise cancels out and the bias is repaired."""
    torch.manual_seed(0)
    bias, noise = 0.3, torch.rand(1, 3, 64, 64) * 0.8 - 0.4
    right = torch.full((1, 3, 64, 64), 1.0)
    frame = frame_of(64, 64).replace(
        color=right - bias, current=right - bias, extra={NOISY: right + noise, NOISY_CURRENT: right + noise}
    )
    network = forced(repair=100, keep=-100)
    with torch.no_grad():
        # All of the coarser scales, in boxes of 4x4 pixels at the coarsest.
        network.heads[0].bias[10 * 4 : 11 * 4] = 100
        network.heads[1].bias[9:11] = torch.tensor([-100.0, 100.0])
        error = network(frame)[0].image - right
    # Means of 16 values of a standard deviation of 0.8 / sqrt(12).
    assert float(error.std()) == pytest.approx(0.8 / 12**0.5 / 4, rel=0.2)
    assert error.mean().abs() < 0.01


def test_a_gradient_reaches_every_weight_and_none_is_asked_of_oidn() -> None:
    model = small(NAME, threads=1).train()
    state = None
    for seed in range(2):
        output, state = model(whole_frame(model, 24, 40, seed=seed), state)
    output.image.sum().backward()
    for name, weight in model.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.isfinite().all(), name
        assert weight.grad.abs().max() > 0, name
    frame = whole_frame(model, 24, 40)
    color = frame.color.requires_grad_()
    message = refused(lambda: model(frame.replace(color=color)))
    assert "the library has no derivatives" in message


def test_gradients_of_the_network_in_float64() -> None:
    network = small_network().double()
    frame = given(9, 10).to(torch.float64)
    weight = network.heads[0].bias

    def image(bias: Tensor) -> Tensor:
        return torch.func.functional_call(network, {"heads.0.bias": bias}, (frame,))[0].image

    assert torch.autograd.gradcheck(image, (weight.detach().clone().requires_grad_(),), atol=1e-6, fast_mode=True)


def small_network() -> RepairNetwork:
    torch.manual_seed(2)
    network = RepairNetwork((6, 8))
    for head in network.heads:
        nn.init.normal_(head.weight, std=0.02)
    return network


def test_a_state_of_tensors_that_ends_with_a_resize() -> None:
    denoiser = Denoiser(small(NAME, threads=1))
    for size in ((24, 40), (24, 40), (17, 21)):
        frame = whole_frame(denoiser.model, *size)
        assert denoiser(frame).shape == frame.color.shape
        leaves = [leaf for leaf in pytree.tree_leaves(denoiser._state) if leaf is not None]
        assert leaves
        assert all(isinstance(leaf, Tensor) for leaf in leaves)
    assert denoiser.report.reset == "size change"


def test_tiles_are_the_whole_image_which_oidn_sees() -> None:
    whole = Denoiser(small(NAME, threads=1))
    tiles = Denoiser(small(NAME, threads=1), tile=64)
    for seed in range(2):
        frame = whole_frame(whole.model, 200, 330, seed=seed)
        torch.testing.assert_close(tiles(frame), whole(frame), rtol=1e-4, atol=1e-4)
    assert tiles.report.tiles.startswith("6 x 4 tiles")


@pytest.mark.parametrize("names", [(), ("albedo",), ("albedo", "normal"), ("normal", "depth"), ("motion",)])
def test_without_features(names: tuple[str, ...]) -> None:
    denoiser = Denoiser(small(NAME, threads=1))
    for seed in range(2):
        frame = whole_frame(denoiser.model, 24, 40, seed=seed)
        image = denoiser(Frame(frame.color, **{name: frame.buffer(name) for name in names}))
        assert image.isfinite().all()
        assert image.min() >= 0


def test_a_copy_has_a_library_of_its_own() -> None:
    model = small(NAME, threads=1, quality="fast")
    other = copy.deepcopy(model)
    frame = whole_frame(model, 24, 40)
    assert other._oidn is not model._oidn
    assert (other._oidn.quality, other._oidn.threads) == ("fast", 1)
    assert torch.equal(other(frame)[0].image, model(frame)[0].image)


def test_without_the_package_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    assert "pip install 'mcdenoise[oidn]'" in refused(lambda: create_model(NAME))


def plane(offsets: Tensor) -> Frame:
    """A plane seen through a point of each pixel: the inverse of its depth is linear in the image."""
    rows, columns = torch.meshgrid(torch.arange(40.0), torch.arange(60.0), indexing="ij")
    inverse = 0.2 + 0.004 * (columns + offsets[0]) + 0.003 * (rows + offsets[1])
    normal = torch.tensor([0.6, 0.0, -0.8]).reshape(1, 3, 1, 1).expand(1, 3, 40, 60)
    return Frame(torch.rand(1, 3, 40, 60), normal=normal, depth=(1 / inverse)[None, None])


def test_features_are_exact_of_rays_through_the_centers_alone() -> None:
    exact = plane(torch.zeros(2, 40, 60))
    assert has_exact_features(exact)
    # As files in half precision have it.
    assert has_exact_features(exact.replace(depth=exact.depth.half().float()))
    assert not has_exact_features(plane(torch.rand(2, 40, 60)))
    mixed = exact.normal.clone()
    mixed[..., ::10] *= 0.8
    assert not has_exact_features(exact.replace(normal=mixed))
    specks = exact.normal.clone()
    specks[..., 5::10, 5::10] *= -1
    assert not has_exact_features(exact.replace(normal=specks))
    # The edges of what is in front are none.
    edges = exact.normal.clone()
    edges[..., 10:30, 20:50] *= -1
    assert has_exact_features(exact.replace(normal=edges))
    assert not has_exact_features(exact.replace(depth=None))
    assert not has_exact_features(exact.replace(normal=None))


@pytest.mark.parametrize("exact", [False, True])
def test_oidn_is_told_whether_features_are_clean(exact: bool) -> None:
    frame = plane(torch.zeros(2, 40, 60) if exact else torch.rand(2, 40, 60)).replace(albedo=torch.rand(1, 3, 40, 60))
    seen = AfterOidn(Noisy(), threads=1).before(frame)
    torch.testing.assert_close(seen.color, oidn_of(frame, "clean" if exact else "noisy"), rtol=1e-4, atol=1e-5)


def test_images_that_are_accumulated_as_well_have_the_weights_of_the_color() -> None:
    """A linear map: an image that is a multiple of the color stays one, in a history of its own."""
    model, state = Accumulated(Seen(), lag_threshold=math.inf, firefly_limit=math.inf, also=(NOISY,)), None
    for seed in range(3):
        frame = whole_frame(model, 24, 40, seed=seed)
        _, state = model(frame.replace(extra={NOISY: 3 * frame.color, "other": frame.color}), state)
        seen = model.inner.frame
        torch.testing.assert_close(seen.extra[NOISY], 3 * seen.color)
        assert torch.equal(seen.extra["other"], frame.color)
    assert not torch.equal(seen.color, frame.color)


class Seen(Noisy):
    def forward(self, frame: Frame, state: Any = None) -> Any:
        self.frame = frame
        return super().forward(frame, state)


def test_training_sees_what_the_whole_model_sees(small_sequence: Path, tmp_path: Path) -> None:
    """OIDN and the histories come from the cache; the rest gives the same images from there."""
    model = small(NAME, threads=1)
    front, rest = split(model)
    assert list(front.parts) == ["color", "current", "length", NOISY, NOISY_CURRENT]
    assert not list(parts_of(rest, AfterOidn))
    sequence = open_sequence(small_sequence)
    features = ["albedo", "normal", "depth"]
    cached = open_cached(sequence, tmp_path, front=front, features=features, firsts=[0, 2])
    for first, shot in zip((0, 2), cached.shots, strict=True):
        clip = Clip.of(shot.read())
        with torch.no_grad():
            found = unroll(rest, clip, has_state=False).image[0]
        state = None
        for number in range(first, len(sequence)):
            frame = sequence.frame(number).validate()[0].with_depth().replace(hints=Hints(keep_all=True))
            with torch.no_grad():
                output, state = model(frame, state)
            torch.testing.assert_close(found[number - first], output.image[0], rtol=1e-3, atol=1e-4)


@pytest.mark.skipif(NAME not in pretrained_models(), reason="there are no weights yet")
def test_with_its_weights_it_is_ahead_of_oidn(small_sequence: Path) -> None:
    denoiser = Denoiser(NAME, threads=1)
    sequence = open_sequence(small_sequence)
    for error in (smape_linear, display_error):
        denoiser.reset()
        ours, best = 0.0, 0.0
        for number in sequence.numbers:
            frame = sequence.frame(number, reference=True)
            assert frame.reference is not None
            ours += float(error(denoiser(frame), frame.reference).mean())
            images = (oidn_of(frame, auxiliary) for auxiliary in ("noisy", "clean"))
            best += min(float(error(image, frame.reference).mean()) for image in images)
        assert ours < best


def test_refuses_what_is_no_setting() -> None:
    with pytest.raises(InputError, match="quality: expected one of"):
        create_model(NAME, quality="best")
