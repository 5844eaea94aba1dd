"""How good a network is while it learns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from mcdenoise.data.cache import Shot
from mcdenoise.data.clips import Clip
from mcdenoise.metrics import displayed, psnr_srgb, smape_linear
from mcdenoise.ops import remodulate

if TYPE_CHECKING:
    from lightning_fabric import Fabric


def denoise_clip(model: nn.Module, clip: Clip) -> tuple[Tensor, Tensor]:
    """Initial and final image of every frame, with albedo, ``(B, T, 3, H, W)``."""
    batch = clip.color.shape[:2]
    names = ("color", "albedo", "normal", "depth", "current", "length")
    inputs = [getattr(clip, name).flatten(0, 1).contiguous(memory_format=torch.channels_last) for name in names]
    initial, final = model(*inputs)
    albedo = clip.albedo.flatten(0, 1)
    return remodulate(initial, albedo).unflatten(0, batch), remodulate(final, albedo).unflatten(0, batch)


@torch.no_grad()
def validate(
    network: nn.Module, watched: list[tuple[str, Shot]], fabric: Fabric, board: Any, step: int
) -> dict[str, float]:
    """Errors of a network on whole frames, one frame at a time, and pictures of them for TensorBoard.

    Args:
        network: not wrapped for several processes; only one of them validates.
        watched: name and frames of each sequence; realisation 0 of the noise.
        fabric: device and precision.
        board: the TensorBoard writer.
        step: optimiser steps done.

    Returns:
        SMAPE and display PSNR of the final and of the initial image, means over each sequence's frames and then over
        the sequences; empty without sequences.
    """
    training = network.training
    network.eval()
    totals: dict[str, float] = {}
    for i, (name, shot) in enumerate(watched):
        for t in range(len(shot)):
            clip = Clip.from_stack(shot.read(slice(t, t + 1))[None]).to(fabric.device)
            with fabric.autocast():
                initial, final = denoise_clip(network, clip)
            for key, score in _scores(initial.float(), final.float(), clip.reference).items():
                totals[key] = totals.get(key, 0.0) + score / len(shot) / len(watched)
        noisy = remodulate(clip.color[0], clip.albedo[0])[0]
        shown = [displayed(image) for image in (noisy, final[0, 0].float(), clip.reference[0, 0])]
        board.add_image(f"validation/{i}-{name}", torch.cat(shown, -1), step)
    network.train(training)
    for key, score in totals.items():
        board.add_scalar(f"validation/{key}", score, step)
    return totals


def _scores(initial: Tensor, final: Tensor, reference: Tensor) -> dict[str, float]:
    return {
        "smape": smape_linear(final, reference).mean().item(),
        "psnr": psnr_srgb(final, reference).mean().item(),
        "initial_smape": smape_linear(initial, reference).mean().item(),
        "initial_psnr": psnr_srgb(initial, reference).mean().item(),
    }
