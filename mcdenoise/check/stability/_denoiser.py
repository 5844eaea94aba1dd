"""Properties of a :class:`mcdenoise.denoiser.Denoiser` that must hold for all frames."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from mcdenoise.check.stability._check import DTYPES, Check, bounded, held
from mcdenoise.check.stability._models import ALLOWED, EXPOSURES, joined, relative_change
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.light import replace_invalid
from mcdenoise.methods import parse_method
from mcdenoise.models import DEFAULT
from mcdenoise.models._precision import Precision
from mcdenoise.models.with_oidn import OIDN, OIDN_CLEAN

FRAMES = 3
# The property of a denoiser that is checked on each shot of unusual values.
VALID_SHOT = "valid"
# Black, bright and even pixels, and some without albedo.
UNEVEN = "uneven radiance"
_SIZE = (17, 23)
_MIDDLE = (8, 11)
_PATTERNS = 8
# Rounding errors of an image that hardly depends on its inputs.
_LEAST = 3
_SOME = (..., slice(3, 9), slice(None))
# NaN in these buffers is rejected; only in color is it repaired.
_REFUSED = ("albedo", "normal", "depth", "position", "motion", "view_projection")
# Unusual values of whole buffers, and of buffers in some rows.
_EVERYWHERE = {"color": (0.0, 1e-40, 1e-30, 65504.0, 1e6, 1e30), "albedo": (0.0, 1e-8, 1.0, 1.9), "normal": (-1.0,)}
_IN_SOME_ROWS = {
    "color": (math.nan, math.inf, -1.0),
    "depth": (0.0, 1e-30, 1e10, math.inf),
    "normal": (0.0, 0.1, 1.0),
    "motion": (1e4, 1e30, math.inf, -math.inf),
    "position": (0.0, 1e10),
    "albedo": (93.0,),
}
_DIFFERENTIATED = (
    UNEVEN,
    "color 0",
    "color 65504",
    "albedo 0",
    "depth inf in some rows",
    "motion inf in some rows",
    "1x1",
)

Shots = dict[str, list[Frame]]


def check_denoiser(model: str = DEFAULT, dtypes: Sequence[torch.dtype] = DTYPES) -> Iterator[Check]:
    """Check all properties with frames in each dtype; with bfloat16, convolutions are in bfloat16 too.

    Args:
        model: a model, see :func:`mcdenoise.methods.parse_method`.
        dtypes: dtypes of the frames.

    Raises:
        InputError: there is no such model, or it has no weights.
    """
    name = f"Denoiser, {model}"
    for dtype in dtypes:
        known = dtype == torch.float16 and torch.float32 in dtypes
        for check in _checks(model, dtype, first=dtype == dtypes[0], known=known):
            yield replace(check, subject=name)


def _checks(model: str, dtype: torch.dtype, *, first: bool, known: bool) -> Iterator[Check]:
    precision: Precision = "bfloat16" if dtype == torch.bfloat16 else "float32"
    denoiser = parse_method(model).denoiser(precision=precision)
    # Skip shots that lack a buffer which the model needs.
    buffers = denoiser.model.needs.buffers
    shots = {name: shot for name, shot in _shots(dtype).items() if all(buffers <= each.buffers for each in shot)}
    # Decisions about the whole image, such as to skip it, are the same in every dtype: one sees each shot alone.
    for batch in [{name: shot} for name, shot in shots.items()] if first else _batches(shots):
        yield from _valid(denoiser, batch, dtype)
    if not buffers <= _frame(0, dtype).buffers:
        return
    if dtype == torch.float32:
        yield from _gradients(model, {name: shots[name] for name in _DIFFERENTIATED})
    yield from _refused(denoiser, dtype)
    # A denoiser computes in float32 with frames of either dtype.
    if not known:
        yield from _contained(denoiser, dtype)
        yield from _exposed(denoiser, dtype)


def _frame(seed: int, dtype: torch.dtype, size: tuple[int, int] = _SIZE) -> Frame:
    """A noisy wall with some mirrors that moves by a fraction of a pixel, seen from a camera at the origin."""
    g = torch.Generator().manual_seed(seed)
    height, width = size
    depth = 2 + torch.rand(1, 1, height, width, generator=torch.Generator().manual_seed(0))
    position = torch.cat([torch.rand(1, 2, height, width, generator=g) - 0.5, depth], 1)
    matrix = torch.eye(4)[None]
    matrix[:, 2, 3], matrix[:, 3, 3] = 1, 0
    albedo = torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(1)) * (depth < 2.8)
    normal = torch.tensor([0.0, 0.0, -1.0]).reshape(1, 3, 1, 1).expand(1, 3, height, width)
    return Frame(
        color=10 ** (4 * torch.rand(1, 3, height, width, generator=g) - 2),
        albedo=albedo,
        normal=normal,
        depth=depth,
        position=position,
        motion=torch.full((1, 2, height, width), 0.25),
        view_projection=matrix,
    ).to(dtype)


def _shots(dtype: torch.dtype) -> Shots:
    """Short shots with the unusual values that renderers write; finite values are clamped to the range of the dtype."""
    frames, limits = [_frame(seed, dtype) for seed in range(FRAMES)], torch.finfo(dtype)

    def changed(name: str, value: float, where: tuple[Any, ...] = (...,)) -> list[Frame]:
        value = min(max(value, limits.min), limits.max) if math.isfinite(value) else value
        buffers = [dict(frame.items())[name].clone() for frame in frames]
        for buffer in buffers:
            buffer[where] = value
        return [frame.replace(**{name: buffer}) for frame, buffer in zip(frames, buffers, strict=True)]

    def uneven(frame: Frame) -> Frame:
        color, albedo = frame.color.clone(), frame.albedo.clone()  # type: ignore[union-attr]
        color[..., 2:5, 2:9], color[..., 6, 3], color[..., 9:12, 8:] = 0, limits.max**0.5, 0.5
        albedo[..., 4:7, :] = 0
        return frame.replace(color=color, albedo=albedo)

    void = torch.ones_like(frames[0].color[:, :1])
    void[_SOME] = 0
    lacking = frames[1].replace(albedo=None, depth=None, position=None)
    return {
        UNEVEN: [uneven(frame) for frame in frames],
        **{f"{name} {value:g}": changed(name, value) for name, values in _EVERYWHERE.items() for value in values},
        **{
            f"{name} {value:g} in some rows": changed(name, value, _SOME)
            for name, values in _IN_SOME_ROWS.items()
            for value in values
        },
        "one row of valid color": changed("color", math.nan, (..., slice(1, None), slice(None))),
        **{f"{h}x{w}": [_frame(seed, dtype, (h, w)) for seed in range(FRAMES)] for h, w in ((1, 1), (1, 9), (9, 1))},
        "nothing but color": [Frame(color=frame.color) for frame in frames],
        # Features that contradict each other, or are missing in some frames.
        "mask 0 in some rows": [frame.replace(mask=void) for frame in frames],
        "void rows": [frame.replace(color=frame.color * void, alpha=void) for frame in frames],
        "albedo without normal": [frame.replace(normal=None) for frame in frames],
        "normal without albedo": [frame.replace(albedo=None) for frame in frames],
        "half the features in every second frame": [frames[0], lacking, *frames[2:]],
    }


def _batches(shots: Shots) -> Iterable[Shots]:
    """Shots whose frames fit into one batch: they have equal sizes and buffers."""
    alike: dict[Any, Shots] = {}
    for name, shot in shots.items():
        alike.setdefault(tuple((frame.size, frame.buffers) for frame in shot), {})[name] = shot
    return alike.values()


def _valid(denoiser: Denoiser, shots: Shots, dtype: torch.dtype) -> Iterator[Check]:
    """Every image is finite and non-negative."""
    denoiser.reset()
    messages = dict.fromkeys(shots, "")
    for number, frames in enumerate(zip(*shots.values(), strict=True)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            images = denoiser(joined(frames))
        for name, image in zip(shots, images, strict=True):
            if not torch.isfinite(image).all() or not (image >= 0).all():
                messages[name] = messages[name] or f"frame {number}: NaN, infinite or negative pixels"
    for name, message in messages.items():
        yield held("Denoiser", name, dtype, VALID_SHOT, message)


def _gradients(model: str, shots: Shots) -> Iterator[Check]:
    """Derivatives of the last image in all buffers of all frames are finite; no checks of a model that has none."""
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
            return
        if not image.requires_grad:
            return
        found = torch.autograd.grad(image.sum(), leaves, allow_unused=True)
        for index, name in enumerate(batch):
            finite = all(bool(gradient[index].isfinite().all()) for gradient in found if gradient is not None)
            yield held("Denoiser", name, torch.float32, "gradient", "" if finite else "a gradient is NaN or infinite")


def _contained(denoiser: Denoiser, dtype: torch.dtype) -> Iterator[Check]:
    """An invalid pixel is repaired: the images are exactly those of frames with the repaired one instead."""
    frames = [_frame(seed, dtype).to(torch.float32) for seed in range(FRAMES)]
    kept = torch.ones_like(frames[0].color, dtype=torch.bool)
    kept[(..., *_MIDDLE)] = False
    for value in (torch.nan, torch.inf, -1.0):
        invalid = [torch.where(kept, frame.color, value) for frame in frames]
        repairs = [replace_invalid(color) for color in invalid]
        mended = [torch.where(kept, frame.color, color) for frame, (color, _) in zip(frames, repairs, strict=True)]
        valid = all(count == 1 and torch.equal(color, m) for m, (color, count) in zip(mended, repairs, strict=True))
        message = "" if valid else "a valid pixel was replaced"
        if not all(map(torch.equal, _images(denoiser, frames, invalid), _images(denoiser, frames, mended))):
            message = message or "an invalid pixel changes its neighbours"
        yield held("Denoiser", f"one pixel of {value:g}", dtype, "contained", message)


def _images(denoiser: Denoiser, frames: Sequence[Frame], colors: Sequence[Tensor]) -> list[Tensor]:
    """The images of a shot with other colors."""
    denoiser.reset()
    return [denoiser(frame.replace(color=color)) for frame, color in zip(frames, colors, strict=True)]


def _refused(denoiser: Denoiser, dtype: torch.dtype) -> Iterator[Check]:
    """NaN in any other buffer is rejected in one line that names it, and the history does not change."""
    frames = [_frame(seed, dtype) for seed in range(2)]
    _, expected = _images(denoiser, frames, [frame.color for frame in frames])
    for name in _REFUSED:
        denoiser.reset()
        denoiser(frames[0])
        buffer = dict(frames[1].items())[name].clone()
        buffer.reshape(-1)[0] = torch.nan
        try:
            denoiser(frames[1].replace(**{name: buffer}))
            message = "accepted"
        except InputError as error:
            message = "" if name in str(error) and "\n" not in str(error) else f"not one clear line: {error}"
        if not message and not torch.equal(denoiser(frames[1]), expected):
            message = "the history was changed by a rejected frame"
        yield held("Denoiser", f"NaN in {name}", dtype, "refused", message)


def _exposed(denoiser: Denoiser, dtype: torch.dtype) -> Iterator[Check]:
    """``denoise(s x) = s denoise(x)``, after a history.

    Scaling rounds every pixel of every frame, and each stage rounds again. So does a change of all colors, albedos and
    normals by ``eps`` relatively, up or down, and the bound is a multiple of what it does to the image. In a deep
    network that is mostly the rounding of its stages, which a larger change would not show. One random pattern of signs
    underestimates it by half or more, so the maximum of several patterns is used. For images that come from the OIDN
    library, of which the result is a mean, their own deviation is allowed in addition. All run as one batch, whose
    images must not see each other.
    """
    eps = torch.finfo(torch.bfloat16 if denoiser.precision == "bfloat16" else torch.float32).eps
    changes: list[Callable[[Frame], Frame]] = [lambda frame: frame]
    changes += [partial(_moved, eps=eps, seed=seed) for seed in range(_PATTERNS)]
    changes += [partial(_scaled, exposure=exposure) for exposure in EXPOSURES]
    frames = [_frame(seed, dtype).to(torch.float32) for seed in range(FRAMES)]
    denoiser.reset()
    outputs = [denoiser.output(joined([change(frame) for change in changes])) for frame in frames]

    def error(image: Tensor, index: int, exposure: float = 1.0) -> float:
        return relative_change(image[index : index + 1] / exposure, image[:1]) / eps

    largest = max(error(outputs[-1].image, index) for index in range(1, 1 + _PATTERNS))
    for index, exposure in enumerate(EXPOSURES, start=1 + _PATTERNS):
        found = error(outputs[-1].image, index, exposure)
        library = (
            error(output.stages[name], index, exposure)
            for output in outputs
            for name in {OIDN, OIDN_CLEAN} & output.stages.keys()
        )
        allowed = ALLOWED * max(largest, _LEAST) + max(library, default=0.0)
        yield bounded("Denoiser", f"exposure {exposure:g}", dtype, "exposure", found, allowed, largest)


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
