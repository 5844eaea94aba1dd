"""Properties of a :class:`mcdenoise.denoiser.Denoiser` that must hold for all frames."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mcdenoise.check.stability._check import DTYPES, Check, name_of
from mcdenoise.check.stability._models import ALLOWED, EXPOSURES, ROUNDED, relative_change
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.light import replace_invalid
from mcdenoise.methods import parse_method
from mcdenoise.models import DEFAULT, Output, Precision
from mcdenoise.models.with_oidn import OIDN, OIDN_CLEAN

FRAMES = 3
# The property of a denoiser that is checked on each shot of unusual values.
VALID_SHOT = "valid"
# Black, bright and even pixels, and some without albedo.
UNEVEN = "uneven radiance"
_DIFFERENTIATED = (
    UNEVEN,
    "radiance 0",
    "radiance 65504",
    "albedo 0",
    "depth inf in some rows",
    "motion inf in some rows",
    "1x1",
)
_SIZE = (17, 23)
_MIDDLE = (8, 11)
_PATTERNS = 8
# NaN in these buffers is rejected; only in color is it repaired.
_REFUSED = ("albedo", "normal", "depth", "position", "motion", "view_projection")


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
        for check in _checks(model, dtype):
            yield replace(check, subject=name)


def _checks(model: str, dtype: torch.dtype) -> Iterator[Check]:
    precision: Precision = "bfloat16" if dtype == torch.bfloat16 else "float32"
    denoiser = parse_method(model).denoiser(precision=precision)
    # Skip shots that lack a buffer which the model needs.
    buffers = denoiser.model.needs.buffers
    for name, frames in _shots(dtype).items():
        if all(buffers <= frame.buffers for frame in frames):
            yield _valid(denoiser, name, frames, dtype)
    if not buffers <= _frame(0, dtype).buffers:
        return
    if dtype == torch.float32:
        yield from _gradients(model, _shots(dtype))
    for value in (torch.nan, torch.inf, -1.0):
        yield _contained(denoiser, value, dtype)
    yield from (_refused(denoiser, name, dtype) for name in _REFUSED)
    yield from (_exposure(denoiser, exposure, dtype) for exposure in EXPOSURES)


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


def _shots(dtype: torch.dtype) -> dict[str, list[Frame]]:
    """Short shots with the unusual values that renderers write; finite values are clamped to the range of the dtype."""
    frames = [_frame(seed, dtype) for seed in range(FRAMES)]
    limits = torch.finfo(dtype)

    def with_value(name: str, value: float, only: slice = slice(None)) -> list[Frame]:
        finite = (
            value if value in (torch.inf, -torch.inf) or value != value else min(max(value, limits.min), limits.max)
        )
        changed = []
        for frame in frames:
            buffer = dict(frame.items())[name].clone()
            buffer[:, :, only] = finite
            changed.append(frame.replace(**{name: buffer}))
        return changed

    some = slice(3, 9)
    uneven = []
    for frame in frames:
        color, albedo = frame.color.clone(), frame.albedo.clone()  # type: ignore[union-attr]
        color[..., 2:5, 2:9], color[..., 6, 3], color[..., 9:12, 8:] = 0, limits.max**0.5, 0.5
        albedo[..., 4:7, :] = 0
        uneven.append(frame.replace(color=color, albedo=albedo))
    shots = {UNEVEN: uneven}
    shots |= {f"radiance {value:g}": with_value("color", value) for value in (0.0, 1e-40, 1e-30, 65504.0, 1e6, 1e30)}
    shots |= {
        f"color {value:g} in some rows": with_value("color", value, some) for value in (torch.nan, torch.inf, -1.0)
    }
    shots |= {"one row of valid color": with_value("color", torch.nan, slice(1, None))}
    shots |= {f"albedo {value:g}": with_value("albedo", value) for value in (0.0, 1e-8, 1.0, 1.9)}
    shots |= {
        f"depth {value:g} in some rows": with_value("depth", value, some) for value in (0.0, 1e-30, 1e10, torch.inf)
    }
    shots |= {f"normal {value:g} in some rows": with_value("normal", value, some) for value in (0.0, 0.1, 1.0)}
    shots |= {
        f"motion {value:g} in some rows": with_value("motion", value, some)
        for value in (1e4, 1e30, torch.inf, -torch.inf)
    }
    shots |= {f"position {value:g} in some rows": with_value("position", value, some) for value in (0.0, 1e10)}
    shots |= {f"{h}x{w}": [_frame(seed, dtype, (h, w)) for seed in range(FRAMES)] for h, w in ((1, 1), (1, 9), (9, 1))}
    shots |= {"nothing but color": [Frame(color=frame.color) for frame in frames]}
    # Features that contradict each other, or are missing in some frames.
    void = torch.ones_like(frames[0].color[:, :1])
    void[:, :, some] = 0
    shots |= {"mask 0 in some rows": [frame.replace(mask=void) for frame in frames]}
    shots |= {"void rows": [frame.replace(color=frame.color * void, alpha=void) for frame in frames]}
    shots |= {"albedo 93 in some rows": with_value("albedo", 93.0, some)}
    shots |= {"normal -1": with_value("normal", -1.0)}
    shots |= {"albedo without normal": [frame.replace(normal=None) for frame in frames]}
    shots |= {"normal without albedo": [frame.replace(albedo=None) for frame in frames]}
    lacking = [frame.replace(albedo=None, depth=None, position=None) for frame in frames]
    shots |= {"half the features in every second frame": [*frames[:1], lacking[1], *frames[2:]]}
    return shots


def _valid(denoiser: Denoiser, name: str, frames: list[Frame], dtype: torch.dtype) -> Check:
    """Every image is finite and non-negative."""
    denoiser.reset()
    message = ""
    for number, frame in enumerate(frames):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = denoiser(frame)
        if not torch.isfinite(image).all() or not (image >= 0).all():
            message = message or f"frame {number}: NaN, infinite or negative pixels"
    return _found(name, dtype, VALID_SHOT, message)


def _gradients(model: str, shots: dict[str, list[Frame]]) -> Iterator[Check]:
    """Derivatives of the last image in all buffers of all frames are finite; no checks of a model that has none."""
    denoiser = parse_method(model).denoiser(differentiable=True)
    for name in _DIFFERENTIATED:
        denoiser.reset()
        leaves: list[Tensor] = []
        try:
            for frame in shots[name]:
                given = {key: image.clone().requires_grad_() for key, image in frame.items()}
                leaves += given.values()
                image = denoiser(frame.replace(**given))
        except InputError:
            # A library without derivatives.
            return
        if not image.requires_grad:
            return
        found = torch.autograd.grad(image.sum(), leaves, allow_unused=True)
        finite = all(bool(torch.isfinite(gradient).all()) for gradient in found if gradient is not None)
        yield _found(name, torch.float32, "gradient", "" if finite else "a gradient is NaN or infinite")


def _contained(denoiser: Denoiser, value: float, dtype: torch.dtype) -> Check:
    """An invalid pixel is repaired: the images are exactly those of frames with the repaired one instead."""
    message, images = "", list[list[Tensor]]()
    for repaired in (False, True):
        denoiser.reset()
        shot = []
        for seed in range(FRAMES):
            frame = _frame(seed, dtype).to(torch.float32)
            color = frame.color.clone()
            color[(..., *_MIDDLE)] = value
            mended, count = replace_invalid(color)
            kept = torch.ones_like(color, dtype=torch.bool)
            kept[(..., *_MIDDLE)] = False
            if count != 1 or not torch.equal(mended[kept], color[kept]):
                message = "a valid pixel was replaced"
            if repaired:
                color[(..., *_MIDDLE)] = mended[(..., *_MIDDLE)]
            shot.append(denoiser(frame.replace(color=color)))
        images.append(shot)
    if not all(torch.equal(a, b) for a, b in zip(*images, strict=True)):
        message = message or "an invalid pixel changes its neighbours"
    return _found(f"one pixel of {value:g}", dtype, "contained", message)


def _refused(denoiser: Denoiser, name: str, dtype: torch.dtype) -> Check:
    """NaN in any other buffer is rejected in one line that names it, and the history does not change."""
    denoiser.reset()
    frames = [_frame(seed, dtype) for seed in range(2)]
    buffer = dict(frames[1].items())[name].clone()
    buffer.reshape(-1)[0] = torch.nan
    denoiser(frames[0])
    try:
        denoiser(frames[1].replace(**{name: buffer}))
        message = "accepted"
    except InputError as error:
        message = "" if name in str(error) and "\n" not in str(error) else f"not one clear line: {error}"
    again = denoiser(frames[1])
    denoiser.reset()
    denoiser(frames[0])
    if not message and not torch.equal(again, denoiser(frames[1])):
        message = "the history was changed by a rejected frame"
    return _found(f"NaN in {name}", dtype, "refused", message)


def _exposure(denoiser: Denoiser, exposure: float, dtype: torch.dtype) -> Check:
    """``denoise(s x) = s denoise(x)``, after a history.

    Scaling rounds every pixel of every frame, and each stage rounds again. So does a change of all colors, albedos and
    normals by ``eps`` relatively, up or down, and the bound is a multiple of what it does to the image. In a deep
    network that is mostly the rounding of its stages, which a larger change would not show. One random pattern of signs
    underestimates it by half or more, so the maximum of several patterns is used. For images that come from the OIDN
    library, of which the result is a mean, their own deviation is allowed in addition.
    """

    def outputs(change: Callable[[Frame], Frame]) -> list[Output]:
        denoiser.reset()
        return [denoiser.output(change(_frame(seed, dtype).to(torch.float32))) for seed in range(FRAMES)]

    def response(seed: int) -> float:
        names, generator = ("color", "albedo", "normal"), torch.Generator().manual_seed(seed)
        signs = {name: torch.randint(0, 2, (1, 3, *_SIZE), generator=generator) * 2 - 1 for name in names}

        def moved(frame: Frame) -> Frame:
            buffers = dict(frame.items())
            changed = {name: buffers[name] * (1 + eps * own) for name, own in signs.items()}
            # In bfloat16 the perturbed normal may be longer than is valid.
            return frame.replace(**{**changed, "normal": changed["normal"].clamp(-1, 1)})

        return relative_change(outputs(moved)[-1].image, plain[-1].image)

    eps = torch.finfo(torch.bfloat16 if denoiser.precision == "bfloat16" else torch.float32).eps
    plain, scaled = outputs(lambda frame: frame), outputs(lambda frame: frame.replace(color=frame.color * exposure))
    largest = max(response(seed) for seed in range(_PATTERNS))
    error = relative_change(scaled[-1].image / exposure, plain[-1].image) / eps
    library = (
        relative_change(after.stages[name] / exposure, before.stages[name]) / eps
        for before, after in zip(plain, scaled, strict=True)
        for name in {OIDN, OIDN_CLEAN} & before.stages.keys()
    )
    allowed = ALLOWED * max(largest / eps, ROUNDED) + max(library, default=0.0)
    message = "" if error <= allowed else f"error {error:.3g} eps, expected at most {allowed:.3g}"
    check = _found(f"exposure {exposure:g}", dtype, "exposure", message)
    return replace(check, error=error, allowed=allowed, condition=largest / eps)


def _found(case: str, dtype: torch.dtype, what: str, message: str) -> Check:
    return Check("Denoiser", case, name_of(dtype), "", what, 0, 0, 0, not message, message)
