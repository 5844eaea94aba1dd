"""Properties of a :class:`mcdenoise.denoiser.Denoiser` that must hold for all frames."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from mcdenoise.check.case import DTYPES
from mcdenoise.check.stability._check import Check, bounded
from mcdenoise.check.stability._frames import (
    ALLOWED,
    EXPOSURES,
    FRAMES,
    PATTERNS,
    UNEVEN,
    Shots,
    frame,
    joined,
    relative_change,
    shots,
)
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.methods import parse_method
from mcdenoise.models import DEFAULT
from mcdenoise.models._precision import Precision
from mcdenoise.models.with_oidn import OIDN, OIDN_CLEAN

# The property of a denoiser that is checked on each shot of unusual values.
VALID_SHOT = "valid"
# Rounding errors of an image that hardly depends on its inputs.
_LEAST = 3
_IN_ROWS = ("depth inf in some rows", "motion inf in some rows")
_DIFFERENTIATED = (UNEVEN, "color 0", "color 65504", "albedo 0", "1x1", *_IN_ROWS)


def check_denoiser(model: str = DEFAULT, dtypes: Sequence[torch.dtype] = DTYPES) -> Iterator[Check]:
    """Check all properties with frames in each dtype; with bfloat16, convolutions are in bfloat16 too.

    Args:
        model: a model, see :func:`mcdenoise.methods.parse_method`.
        dtypes: dtypes of the frames.

    Raises:
        InputError: there is no such model, or it has no weights.
    """
    found = partial(bounded, f"Denoiser, {model}")
    for dtype in dtypes:
        precision: Precision = "bfloat16" if dtype == torch.bfloat16 else "float32"
        denoiser = parse_method(model).denoiser(precision=precision)
        # Skip shots that lack a buffer which the model needs.
        buffers = denoiser.model.needs.buffers
        every = {name: shot for name, shot in shots(dtype).items() if all(buffers <= each.buffers for each in shot)}
        # Decisions about the whole image, such as to skip it, are the same in every dtype: one sees each shot alone.
        for batch in [{name: shot} for name, shot in every.items()] if dtype == dtypes[0] else _batches(every):
            for name, message in _invalid(denoiser, batch).items():
                yield found(name, dtype, VALID_SHOT, message=message)
        if not buffers <= frame(0, dtype).buffers:
            continue
        if dtype == torch.float32:
            for name, message in _without_derivatives(model, {name: every[name] for name in _DIFFERENTIATED}).items():
                yield found(name, dtype, "gradient", message=message)
        # A denoiser computes in float32 with frames of either dtype.
        if dtype != torch.float16 or torch.float32 not in dtypes:
            for exposure, errors in _exposed(denoiser, dtype):
                yield found(f"exposure {exposure:g}", dtype, "exposure", *errors)


def _batches(shots: Shots) -> Iterable[Shots]:
    """Shots whose frames fit into one batch: they have equal sizes and buffers."""
    alike: dict[Any, Shots] = {}
    for name, shot in shots.items():
        alike.setdefault(tuple((frame.size, frame.buffers) for frame in shot), {})[name] = shot
    return alike.values()


def _invalid(denoiser: Denoiser, shots: Shots) -> dict[str, str]:
    """Where an image of a shot is not finite and non-negative; empty if all are."""
    denoiser.reset()
    messages = dict.fromkeys(shots, "")
    for number, frames in enumerate(zip(*shots.values(), strict=True)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            images = denoiser(joined(frames))
        for name, image in zip(shots, images, strict=True):
            if not torch.isfinite(image).all() or not (image >= 0).all():
                messages[name] = messages[name] or f"frame {number}: NaN, infinite or negative pixels"
    return messages


def _without_derivatives(model: str, shots: Shots) -> dict[str, str]:
    """Whether derivatives of a shot's last image in all its buffers are not finite; no shots if the model has none."""
    messages: dict[str, str] = {}
    denoiser = parse_method(model).denoiser(differentiable=True)
    for batch in _batches(shots):
        denoiser.reset()
        leaves: list[Tensor] = []
        try:
            for frames in zip(*batch.values(), strict=True):
                frame = joined(frames).map(lambda image: image.detach().requires_grad_())
                leaves += dict(frame.items()).values()
                image = denoiser(frame)
        except InputError:
            # A library without derivatives.
            return messages
        if not image.requires_grad:
            return messages
        found = torch.autograd.grad(image.sum(), leaves, allow_unused=True)
        for index, name in enumerate(batch):
            finite = all(bool(gradient[index].isfinite().all()) for gradient in found if gradient is not None)
            messages[name] = "" if finite else "a gradient is NaN or infinite"
    return messages


def _exposed(denoiser: Denoiser, dtype: torch.dtype) -> Iterator[tuple[float, tuple[float, float, float]]]:
    """``denoise(s x) = s denoise(x)``, after a history: by exposure the error, its bound, and that of rounding.

    Scaling rounds every pixel of every frame, and each stage rounds again. So does a change of all colors, albedos and
    normals by ``eps`` relatively, up or down, and the bound is a multiple of what it does to the image. In a deep
    network that is mostly the rounding of its stages, which a larger change would not show. One random pattern of signs
    underestimates it by half or more, so the maximum of several patterns is used. For images that come from the OIDN
    library, of which the result is a mean, their own deviation is allowed in addition. All run as one batch, whose
    images must not see each other.
    """
    eps = torch.finfo(torch.bfloat16 if denoiser.precision == "bfloat16" else torch.float32).eps
    changes: list[Callable[[Frame], Frame]] = [lambda frame: frame]
    changes += [partial(_moved, eps=eps, seed=seed) for seed in range(PATTERNS)]
    changes += [partial(_scaled, exposure=exposure) for exposure in EXPOSURES]
    frames = [frame(seed, dtype).to(torch.float32) for seed in range(FRAMES)]
    denoiser.reset()
    outputs = [denoiser.output(joined([change(frame) for change in changes])) for frame in frames]

    def error(image: Tensor, index: int, exposure: float = 1.0) -> float:
        return relative_change(image[index : index + 1] / exposure, image[:1]) / eps

    largest = max(error(outputs[-1].image, index) for index in range(1, 1 + PATTERNS))
    for index, exposure in enumerate(EXPOSURES, start=1 + PATTERNS):
        found = error(outputs[-1].image, index, exposure)
        library = (
            error(output.stages[name], index, exposure)
            for output in outputs
            for name in {OIDN, OIDN_CLEAN} & output.stages.keys()
        )
        allowed = ALLOWED * max(largest, _LEAST) + max(library, default=0.0)
        yield exposure, (found, allowed, largest)


def _moved(frame: Frame, eps: float, seed: int) -> Frame:
    """The frame with every pixel of light, albedo and normal up or down by ``eps`` relatively."""
    buffers, generator = dict(frame.items()), torch.Generator().manual_seed(seed)
    names = ("color", "albedo", "normal")
    signs = {name: torch.randint(0, 2, buffers[name].shape, generator=generator) * 2 - 1 for name in names}
    changed = {name: buffers[name] * (1 + eps * own) for name, own in signs.items()}
    # In bfloat16 the perturbed normal may be longer than is valid.
    return frame.replace(**{**changed, "normal": changed["normal"].clamp(-1, 1)})


def _scaled(frame: Frame, exposure: float) -> Frame:
    return frame.replace(color=frame.color * exposure)
