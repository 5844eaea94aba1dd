"""Other denoisers: Open Image Denoise as its own package calls it, and kornia's joint bilateral filter."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest
import torch
from kornia.filters import joint_bilateral_blur
from torch import Tensor

import mcdenoise.peers
from mcdenoise.frame import Frame
from mcdenoise.data import open_sequence
from mcdenoise.denoiser import Images
from mcdenoise.errors import InputError
from mcdenoise.history import History
from mcdenoise.ops import HistoryLag, demodulate, remodulate
from mcdenoise.peers import JointBilateral, Oidn, OidnPeer, joint_bilateral_peers, oidn_peers


def some_frame(height: int = 36, width: int = 52, batch: int = 1) -> Frame:
    torch.manual_seed(0)
    albedo = torch.rand(batch, 3, height, width)
    normal = torch.nn.functional.normalize(torch.randn(batch, 3, height, width), dim=1)
    return Frame(color=albedo * torch.rand(batch, 3, height, width) * 5, albedo=albedo, normal=normal)


def some_images(frame: Frame) -> Images:
    accumulated = 0.7 * frame.color + 0.1
    return Images(frame.color, accumulated, accumulated, accumulated)


def channels_last(image: Tensor) -> Tensor:
    return image[0].permute(1, 2, 0).contiguous()


@pytest.fixture(scope="module")
def oidn() -> Oidn:
    pytest.importorskip("pyoidn", reason="Open Image Denoise is in the extra mcdenoise[peers]")
    return Oidn(threads=1)


@pytest.mark.parametrize("clean", [False, True])
@pytest.mark.parametrize("quality", ["fast", "balanced", "high"])
def test_oidn_is_what_its_package_computes(oidn: Oidn, quality: str, clean: bool) -> None:
    import pyoidn

    frame = some_frame()
    guides = channels_last(frame.albedo), channels_last(frame.normal)
    expected = pyoidn.denoise(channels_last(frame.color), *guides, hdr=True, clean_aux=clean, quality=quality)
    # Twice, with another frame between: filters and buffers are used again.
    for _ in range(2):
        result = oidn.denoise(frame.color, frame.albedo, frame.normal, quality=quality, clean_aux=clean)
        torch.testing.assert_close(channels_last(result), expected, rtol=1e-4, atol=1e-5)
        other = oidn.denoise(frame.color * 2, frame.normal.abs(), frame.normal, quality=quality, clean_aux=clean)
        assert not torch.allclose(other, result)


def test_oidn_takes_batches_other_sizes_and_fewer_features(oidn: Oidn) -> None:
    large, small = some_frame(batch=2), some_frame(17, 21)
    both = oidn.denoise(large.color, large.albedo, large.normal)
    alone = oidn.denoise(small.color)
    assert both.shape == (2, 3, 36, 52)
    assert alone.shape == (1, 3, 17, 21)
    second = oidn.denoise(large.color[1:], large.albedo[1:], large.normal[1:])
    torch.testing.assert_close(both[1:], second, rtol=1e-4, atol=1e-5)
    assert torch.equal(oidn.denoise(small.color, normal=small.normal), alone)
    assert torch.isfinite(both).all()
    assert both.min() >= 0


def test_high_quality_is_another_network_only_with_clean_features(oidn: Oidn) -> None:
    frame = some_frame()
    for clean in (False, True):
        high, balanced = (
            oidn.denoise(frame.color, frame.albedo, frame.normal, quality=quality, clean_aux=clean)
            for quality in ("high", "balanced")
        )
        assert torch.equal(high, balanced) is not clean


def test_prefiltering_is_the_package_s_own(oidn: Oidn) -> None:
    import pyoidn

    frame = some_frame()
    filtered = oidn.prefiltered(frame)
    for name in ("albedo", "normal"):
        image, output = channels_last(getattr(frame, name)), torch.zeros(36, 52, 3)
        with pyoidn.Device() as device:
            device.commit()
            with pyoidn.Filter(device, "RT") as one:
                one.set_image(name, image, pyoidn.OIDN_FORMAT_FLOAT3)
                one.set_image("output", output, pyoidn.OIDN_FORMAT_FLOAT3)
                one.commit()
                one.execute()
            assert device.get_error() is None
        torch.testing.assert_close(channels_last(getattr(filtered, name)), output, rtol=1e-4, atol=1e-5)
        assert not torch.allclose(output, image)
    assert filtered.color is frame.color


def test_oidn_peers_are_every_setting(oidn: Oidn) -> None:
    peers = oidn_peers(threads=1)
    assert len({peer.name for peer in peers}) == 36
    assert {peer.family for peer in peers} == {"OIDN"}
    assert {peer.group for peer in peers} == {
        f"OIDN {quality}, {source}"
        for quality in ("fast", "balanced", "high")
        for source in ("raw", "accumulated", "accumulated after")
    }
    by_name = {peer.name: peer for peer in peers}
    frame = some_frame()
    images = some_images(frame)
    raw = by_name["OIDN fast, noisy aux, raw"](frame, images)
    torch.testing.assert_close(raw, oidn.denoise(frame.color, frame.albedo, frame.normal, quality="fast"))
    accumulated = by_name["OIDN high, clean aux, accumulated"](frame, images)
    expected = oidn.denoise(images.accumulated, frame.albedo, frame.normal, clean_aux=True)
    torch.testing.assert_close(accumulated, expected)
    demodulated = by_name["OIDN high, clean aux, demodulated"](frame, images)
    light = oidn.denoise(demodulate(images.accumulated, frame.albedo), frame.albedo, frame.normal, clean_aux=True)
    torch.testing.assert_close(demodulated, remodulate(light, frame.albedo))
    filtered = oidn.prefiltered(frame)
    expected = oidn.denoise(frame.color, filtered.albedo, filtered.normal, quality="balanced", clean_aux=True)
    for _ in range(2):
        torch.testing.assert_close(by_name["OIDN balanced, prefiltered aux, raw"](frame, images), expected)
    torch.testing.assert_close(OidnPeer(oidn, "balanced", "prefiltered", "raw")(frame, images), expected)


def test_accumulated_after_is_the_history_of_denoised_frames(oidn: Oidn, small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    peer, history = OidnPeer(oidn, "fast", "clean", "accumulated after"), History(anti_lag=HistoryLag(math.inf))
    results = []
    for number in (0, 1, 2):
        frame, _ = sequence.frame(number).validate()
        results.append(peer(frame, some_images(frame)))
        alone = oidn.denoise(frame.color, frame.albedo, frame.normal, quality="fast", clean_aux=True)
        past = history.update(frame.replace(color=alone))
        torch.testing.assert_close(results[-1], remodulate(past.color, frame.albedo))
    assert past.reset == ""
    assert past.length.max() == 3
    # The first frame has no past, and neither has one after a reset.
    frame, _ = sequence.frame(2).validate()
    peer.reset()
    torch.testing.assert_close(peer(frame, some_images(frame)), alone, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(results[-1], alone, rtol=1e-2, atol=1e-2)


def test_peers_do_with_a_frame_of_color_alone(oidn: Oidn) -> None:
    frame = Frame(color=some_frame().color)
    images = some_images(frame)
    settings = [OidnPeer(oidn, "fast", aux, "demodulated") for aux in ("noisy", "clean", "prefiltered")]
    settings.append(OidnPeer(oidn, "fast", "noisy", "accumulated after"))
    for peer in [*settings, JointBilateral(0.2, 1.5)]:
        assert torch.isfinite(peer(frame, images)).all()


def test_without_the_package_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(InputError, match=r"needs pyoidn, .*pip install 'mcdenoise\[peers\]'") as caught:
        oidn_peers()
    assert "\n" not in str(caught.value)


def test_the_plain_filter_is_that_of_kornia(small_sequence: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One setting written out with kornia's own function; strips of a few rows change nothing."""
    frame = open_sequence(small_sequence).frame(1)
    images = some_images(frame)
    depth = torch.where(frame.depth.isfinite(), frame.depth, 1)
    typical = torch.exp(torch.log(depth).sum() / frame.depth.isfinite().sum())
    nearness = torch.where(frame.depth.isfinite(), depth / (depth + typical), 1)
    guide = torch.cat([frame.albedo, frame.normal, 10 * nearness], 1)
    textured = (frame.albedo >= 1e-4).any(1, keepdim=True)
    divisor = torch.where(textured, frame.albedo.clamp_min(0.01), 1)
    expected = divisor * joint_bilateral_blur(
        images.accumulated / divisor,
        guide,
        11,
        0.2,
        (2.5, 2.5),
        border_type="replicate",
        color_distance_type="l2",
    )
    torch.testing.assert_close(JointBilateral(0.2, 2.5)(frame, images), expected)
    monkeypatch.setattr(mcdenoise.peers, "_UNFOLDED_VALUES", 3 * 10 * 24 * 11**2)
    torch.testing.assert_close(JointBilateral(0.2, 2.5)(frame, images), expected)


def test_the_sweep_has_twenty_settings() -> None:
    peers = joint_bilateral_peers()
    assert len({peer.name for peer in peers}) == 20
    assert {(peer.group, peer.family) for peer in peers} == {("joint bilateral", "joint bilateral")}
