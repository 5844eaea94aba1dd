"""Validation of a network during training."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mcdenoise.metrics import displayed, psnr_srgb, smape_linear
from mcdenoise.models import Model, State
from mcdenoise.ops import remodulate
from mcdenoise.train.clips import Clip
from mcdenoise.train.losses import RESULT, seen_stages
from mcdenoise.train.shots import Shot

if TYPE_CHECKING:
    from lightning_fabric import Fabric


@torch.no_grad()
def validate(
    model: Model,
    watched: list[tuple[str, Shot]],
    fabric: Fabric,
    board: Any,
    step: int,
) -> dict[str, float]:
    """Compute the errors of a model on whole frames, and write images to TensorBoard.

    Args:
        model: the unwrapped model; only one process validates.
        watched: name and frames of each sequence; the first noise seed is used. A model with a state begins without
            one.
        fabric: device and precision.
        board: the TensorBoard writer.
        step: optimiser steps done.

    Returns:
        SMAPE and display PSNR of the result (``smape``, ``psnr``) and of the stage ``initial`` (``initial_smape``,
        ``initial_psnr``): means over each sequence's frames and then over the sequences; empty without sequences.
    """
    totals: dict[str, float] = {}
    for i, (name, shot) in enumerate(watched):
        state: State = None
        for t in range(len(shot)):
            clip = Clip({name: buffer[None] for name, buffer in shot.read(slice(t, t + 1)).items()})
            frame = clip.to(fabric.device).frame(0)
            with fabric.autocast():
                output, state = model(frame, state)
            for stage, image in seen_stages(output).items():
                for key, score in _scores(stage, image.float(), frame.reference).items():
                    totals[key] = totals.get(key, 0.0) + score / shot.references / len(watched)
        noisy = frame.color
        if shot.demodulated and frame.albedo is not None:
            noisy = remodulate(noisy, frame.albedo)
        shown = [displayed(image)[0] for image in (noisy, output.image.float(), frame.reference) if image is not None]
        board.add_image(f"validation/{i}-{name}", torch.cat(shown, -1), step)
    for key, score in totals.items():
        board.add_scalar(f"validation/{key}", score, step)
    return totals


def _scores(stage: str, image: Tensor, reference: Tensor | None) -> dict[str, float]:
    if reference is None:
        return {}
    prefix = "" if stage == RESULT else f"{stage}_"
    return {
        f"{prefix}smape": smape_linear(image, reference).mean().item(),
        f"{prefix}psnr": psnr_srgb(image, reference).mean().item(),
    }
