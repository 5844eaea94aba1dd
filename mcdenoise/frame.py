"""A frame: the buffers of one image, checked, and as a pytree."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.utils import _pytree as pytree

from mcdenoise.arrays import of_array, unmasked
from mcdenoise.buffers import (
    BUFFERS,
    MOTION,
    RADIANCE,
    BufferSpec,
    Layout,
    check_values,
    clamped,
    ordinary,
    tells_motion,
)
from mcdenoise.errors import InputError, check_choice, did_you_mean
from mcdenoise.light import Repairs, is_valid, repair, repairs_from

# The vocabulary of buffers belongs to frames.
__all__ = ["BUFFERS", "MOTION", "OF_RENDERERS", "RADIANCE", "BufferSpec", "Frame", "Hints", "Layout"]
__all__ += ["Skip", "scale_samples", "tells_motion"]


class Hints(NamedTuple):
    """Facts about a frame besides its pixels. They change an image by a tolerance at most.

    Args:
        still: nothing in the image has moved since the previous frame.
        last: no frame follows, so that no state needs to be kept.
        alone: there is no previous frame either.
        stages: the intermediate images are also requested.
        keep_all: nothing may be skipped, even if the scene does not need it.
        alpha: the alpha is also to be denoised, as the denoiser or the frame says; otherwise it is ignored.
    """

    still: bool = False
    last: bool = False
    alone: bool = False
    stages: bool = True
    keep_all: bool = False
    alpha: bool = False


_NO_HINTS = Hints()


class Skip(NamedTuple):
    """Pixels that need no computing, because their result is known.

    Args:
        mask: ``(B, 1, H, W)`` bool, true where the result is known.
        image: ``(B, 3, H, W)`` that result, finite everywhere, and used where ``mask`` is true.
    """

    mask: Tensor
    image: Tensor


# eq=False: comparing tensors has no single truth value, so frames are equal only to themselves.
@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a renderer's outputs: every buffer is ``(B, C, H, W)``, all of the same batch, size and device.

    Only ``color`` is required. The constructor checks shapes, dtypes and devices, which is fast; :meth:`validate`
    checks every value. A frame is a pytree, so ``torch.func``, ``torch.export`` and ``torch.compile`` accept it.

    Args:
        color: ``(B, 3, H, W)`` noisy radiance, scene-linear, non-negative, unclamped.
        albedo: ``(B, 3, H, W)`` diffuse reflectance in [0, 1]; 0 on emitters, mirrors, glass and background.
        normal: ``(B, 3, H, W)`` world-space unit shading normal in [-1, 1]; 0 where nothing was hit.
        depth: ``(B, 1, H, W)`` distance along the view axis in scene units; ``inf`` where nothing was hit.
        position: ``(B, 3, H, W)`` world-space hit point in scene units.
        motion: ``(B, 2, H, W)`` pixels, x right and y down, ``previous_position = current_position + motion``;
            infinite where there is no previous position.
        previous_position: ``(B, 3, H, W)`` world-space position, in the previous frame, of the surface point that is
            visible now; equal to ``position`` where nothing moves. The previous normal of this point is not stored:
            comparisons of normals across frames use the current one, as if objects moved without rotating.
        view_projection: ``(B, 4, 4)`` row-vector world-to-clip matrix, ``clip = [x y z 1] @ M``; clip y points down.
        diffuse: ``(B, 3, H, W)`` noisy radiance by diffuse reflection.
        specular: ``(B, 3, H, W)`` noisy radiance by specular reflection.
        specular_albedo: ``(B, 3, H, W)`` specular reflectance in [0, 1].
        roughness: ``(B, 1, H, W)`` in [0, 1]; 0 is a mirror.
        emission: ``(B, 3, H, W)`` radiance of the surface itself, without noise.
        variance: ``(B, 3, H, W)`` variance of ``color`` as a mean of samples.
        alpha: ``(B, 1, H, W)`` coverage in [0, 1].
        mask: ``(B, 1, H, W)`` validity: 0 marks void pixels, which neither give nor take light (a denoiser keeps their
            values); others are 1.
        samples: ``(B, S, C, H, W)`` single samples; the first three channels are radiance.
        reference: ``(B, 3, H, W)`` converged radiance of the same pixels.
        current: ``(B, 3, H, W)`` radiance of the current frame, if ``color`` is accumulated: added by the wrapper
            :class:`mcdenoise.models.Accumulated`.
        recent: ``(B, 3, H, W)`` radiance of a shorter history, of about the last four frames; added by the same wrapper
            where it tests for lag.
        length: ``(B, 1, H, W)`` history length of ``color`` in frames, at least 1; added by the same wrapper.
        extra: further ``(B, C, H, W)`` buffers by name.
        layers: ``(B, 3, H, W)`` radiance by name, such as diffuse and glossy light, which adds up to ``color``: parts
            to denoise so that they still add up. A method receives layers that add up to all of ``color``;
            :class:`mcdenoise.denoiser.Denoiser` adds the remainder.
        statistics: values computed from the whole image before it is divided into tiles, ``(B, N, 1, 1)`` by name.
        skip: pixels with a known result, see :class:`Skip`.
        hints: see :class:`Hints`.

    Raises:
        InputError: a buffer has the wrong type, number of channels, size, dtype or device. The message names it.

    Example:
        >>> frame = Frame(color=torch.rand(1, 3, 4, 6), depth=torch.ones(1, 1, 4, 6))
        >>> frame.size
        (4, 6)
        >>> Frame(color=torch.rand(1, 3, 4, 6), albedo=torch.rand(1, 3, 4, 5))
        Traceback (most recent call last):
        ...
        mcdenoise.errors.InputError: buffer 'albedo': expected shape (1, 3, 4, 6) like 'color', found (1, 3, 4, 5)
    """

    color: Tensor
    albedo: Tensor | None = None
    normal: Tensor | None = None
    depth: Tensor | None = None
    position: Tensor | None = None
    motion: Tensor | None = None
    previous_position: Tensor | None = None
    view_projection: Tensor | None = None
    diffuse: Tensor | None = None
    specular: Tensor | None = None
    specular_albedo: Tensor | None = None
    roughness: Tensor | None = None
    emission: Tensor | None = None
    variance: Tensor | None = None
    alpha: Tensor | None = None
    mask: Tensor | None = None
    samples: Tensor | None = None
    reference: Tensor | None = None
    current: Tensor | None = None
    recent: Tensor | None = None
    length: Tensor | None = None
    extra: Mapping[str, Tensor] = field(default_factory=dict)
    layers: Mapping[str, Tensor] = field(default_factory=dict)
    statistics: Mapping[str, Tensor] = field(default_factory=dict)
    skip: Skip | None = None
    hints: Hints = _NO_HINTS

    def __post_init__(self) -> None:
        ordinary("buffer 'color'", self.color)
        if self.color.ndim != 4 or self.color.shape[1] != 3 or 0 in self.color.shape:
            raise InputError(f"buffer 'color': expected shape (B, 3, H, W), found {tuple(self.color.shape)}")
        batch, _, height, width = self.color.shape
        for name, value in self.items():
            ordinary(f"buffer '{name}'", value)
            shape: tuple[int, ...] = (batch, 4, 4)
            if name != "view_projection":
                found = value.shape[-3] if value.ndim > 2 else 1
                channels = BUFFERS[name].channels if name in BUFFERS else max(found, 1)
                samples = [max(count, 1) for count in value.shape[1:2]] if name == "samples" else []
                shape = (batch, *samples, channels, height, width)
            _check_like(f"buffer '{name}'", value, self.color, shape)
        for name, value in self.layers.items():
            _check_like(f"layer '{name}'", ordinary(f"layer '{name}'", value), self.color, tuple(self.color.shape))

    @classmethod
    def from_numpy(
        cls,
        color: ArrayLike,
        *,
        layout: Layout = "HWC",
        extra: Mapping[str, ArrayLike] | None = None,
        **buffers: ArrayLike | None,
    ) -> Frame:
        """Make a frame of one image from arrays without a batch axis, as renderers' Python interfaces provide them.

        Arrays may have any float dtype, which is kept (``longdouble`` becomes float64), any strides and byte order. A
        tensor shares the memory of its array if that is writable, in native byte order and without negative strides;
        otherwise it is a copy.

        Args:
            color: ``(H, W, 3)`` in the layout ``"HWC"``, ``(3, H, W)`` in ``"CHW"``; or one channel, ``(H, W)`` too,
                which is grey. The mask of a masked array becomes the buffer ``mask``.
            layout: layout of every array. It is never guessed: an array of another layout is rejected.
            extra: further buffers by name, each ``(H, W)`` or with any number of channels.
            buffers: buffers of :class:`Frame` by name, such as ``albedo``, in the same layout; a single channel may be
                ``(H, W)``, samples are ``(S, H, W, C)`` or ``(S, C, H, W)``, ``view_projection`` is ``(4, 4)``.

        Raises:
            InputError: an array has another layout, size or number of channels, or does not hold floats, or the name of
                a buffer is unknown; the message names the buffer, and gives shapes in the layout.

        Example:
            >>> import numpy as np
            >>> frame = Frame.from_numpy(np.ones((4, 6, 3), np.float32), depth=np.ones((4, 6), np.float32))
            >>> frame.color.shape, frame.depth.shape
            (torch.Size([1, 3, 4, 6]), torch.Size([1, 1, 4, 6]))
            >>> Frame.from_numpy(np.ones((3, 4, 6)))
            Traceback (most recent call last):
            ...
            mcdenoise.errors.InputError: buffer 'color': expected shape (H, W, 3), found (3, 4, 6); pass layout='CHW'
        """
        check_choice("layout", layout, Layout)
        if unknown := set(buffers) - OF_RENDERERS:
            known, near = sorted(OF_RENDERERS), did_you_mean(min(unknown), OF_RENDERERS)
            raise InputError(
                f"buffer '{min(unknown)}': expected one of {', '.join(known)}; others go into extra={{...}}"
                f"{near and '; '}{near}"
            )
        color, valid = unmasked(color, layout)
        image = of_array("color", color, layout, None)
        size = (image.shape[2], image.shape[3])
        given: dict[str, Any] = {
            name: of_array(name, value, layout, size) for name, value in buffers.items() if value is not None
        }
        if valid is not None:
            own = of_array("mask", valid, layout, size)
            given["mask"] = torch.minimum(own, given.get("mask", own))
        for name in extra or {}:
            if name in _NAMES:
                raise InputError(f"extra: expected names that Frame does not know, found '{name}'; pass {name}=...")
        others = {name: of_array(name, value, layout, size) for name, value in (extra or {}).items()}
        return cls(color=image, **given, extra=others)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.color.shape[2], self.color.shape[3]

    @property
    def buffers(self) -> frozenset[str]:
        """Names of the buffers that are present."""
        return frozenset(name for name, _ in self.items())

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """Name and tensor of every buffer that is present, those of ``extra`` last."""
        for name in _NAMES:
            value = getattr(self, name)
            if value is not None:
                yield name, value
        yield from self.extra.items()

    def buffer(self, name: str) -> Tensor | None:
        """A buffer by name, also one of ``extra``; ``None`` if the frame does not have it."""
        found: Tensor | None = getattr(self, name) if name in _NAMES else self.extra.get(name)
        return found

    def replace(self, **changes: Any) -> Frame:
        """The same frame with some fields changed."""
        return replace(self, **changes)

    def map(self, function: Callable[[Tensor], Tensor]) -> Frame:
        """The same frame with a function applied to every buffer and layer."""
        changed: dict[str, Any] = {name: function(value) for name, value in self.items() if name in _NAMES}
        extra = {name: function(value) for name, value in self.extra.items()}
        layers = {name: function(value) for name, value in self.layers.items()}
        return replace(self, **changed, extra=extra, layers=layers)

    def to(self, target: torch.device | torch.dtype | str) -> Frame:
        """Every buffer and layer moved to a device or converted to a dtype."""
        return self.map(lambda value: value.to(target))

    def crop(self, rows: slice, columns: slice) -> Frame:
        """A rectangle of the frame, as views, seen by the camera of that part; ``rows`` and ``columns`` skip none.

        Its statistics stay those of the whole image, and nothing of it is skipped.
        """
        images = replace(self, view_projection=None, skip=None).map(lambda value: value[..., rows, columns])
        view = self.view_projection
        return replace(images, view_projection=None if view is None else part_of_view(view, self.size, rows, columns))

    def with_depth(self) -> Frame:
        """The frame with a depth computed from positions and a camera (clip w), if it has these but no depth."""
        if self.depth is not None or self.position is None or self.view_projection is None:
            return self
        column = self.view_projection[:, :, 3, None, None]
        depth = (self.position * column[:, :3]).sum(1, keepdim=True) + column[:, 3:]
        return self.replace(depth=torch.where(depth > 0, depth, torch.inf))

    def without_history(self) -> Frame:
        """The frame without the buffers that are only needed with a history."""
        return self.replace(**dict.fromkeys(MOTION))

    def validate(self) -> tuple[Frame, int]:
        """Check every value: repair NaN, infinite and negative radiance; reject any other invalid buffer.

        Pixels of ``color`` and of layers with NaN, infinity, a negative value or one above 1e16 are replaced as
        :func:`mcdenoise.light.replace_invalid` does it, so that these values do not spread. All layers are replaced
        where ``color`` is, so that they still add up.
        Values of ``albedo`` and ``normal`` that exceed their range by rounding are clamped, and so are albedos up to 2
        (rough conductors evaluated at the normal). Albedos above 2 are clamped, with a warning, if they are less than
        half of the buffer.

        Returns:
            The valid frame, and the number of replaced pixels of ``color``.

        Raises:
            InputError: another buffer holds NaN, an illegal infinity or a value far outside its range; ``color`` has no
                value at all, or half as much negative light as positive; or a layer has that, or invalid values in
                more than a tenth of the pixels in which ``color`` is valid.
        """
        frame, repairs = self.inspect()
        return frame, repairs.pixels

    def inspect(self) -> tuple[Frame, Repairs]:
        """Like :meth:`validate`, and tell all that was invalid in ``color`` and the layers."""
        changes: dict[str, Any] = {}
        repairs = Repairs()
        if not all(map(is_valid, (self.color, *self.layers.values()))):
            color, layers, numbers = repair(self.color, self.layers, reads=True)
            repairs = repairs_from(numbers.tolist(), list(layers))
            changes |= {"color": color, "layers": layers}
        for name, value in self.items():
            if name != "color":
                clean = check_values(name, value)
                if clean is not value:
                    changes[name] = clean
        return self.replace(**changes) if changes else self, repairs

    def repaired(self) -> tuple[Frame, Tensor, Callable[[Sequence[float]], Repairs]]:
        """Like :meth:`validate` without waiting for the device: repair everything, and read nothing.

        Returns:
            The frame, numbers ``(N,)`` on its device that tell which values were invalid, and a function that judges
            these numbers once they have been read: it raises the errors of :meth:`validate`. The frame keeps values
            that would be rejected, except that they are clamped to their range.
        """
        color, layers, of_light = repair(self.color, self.layers, reads=False)
        others = {name: value for name, value in self.items() if name != "color"}
        changes, numbers, judge_others = clamped(others)

        def judge(read: Sequence[float]) -> Repairs:
            repairs = repairs_from(read[: len(of_light)], list(layers))
            judge_others(read[len(of_light) :])
            return repairs

        # Created on the device, because copying a number from the host would wait.
        numbers = [number.to(of_light.dtype)[None] for number in numbers]
        return self.replace(color=color, layers=layers, **changes), torch.cat([of_light, *numbers]), judge


_OF_HOSTS = ("extra", "layers", "statistics", "skip")
_NAMES = tuple(each.name for each in fields(Frame) if each.name not in (*_OF_HOSTS, "hints"))
# Buffers that a renderer provides in addition to the color; the others are added by wrappers.
OF_RENDERERS = frozenset(_NAMES) - {"color", "current", "recent", "length"}


def _flatten(frame: Frame) -> tuple[list[Any], tuple[tuple[str, ...], Hints]]:
    present = tuple(name for name in (*_NAMES, *_OF_HOSTS) if getattr(frame, name) is not None)
    values = (getattr(frame, name) for name in present)
    return [dict(value) if isinstance(value, Mapping) else value for value in values], (present, frame.hints)


def _flatten_with_keys(frame: Frame) -> tuple[list[tuple[Any, Any]], tuple[tuple[str, ...], Hints]]:
    children, context = _flatten(frame)
    return [(pytree.GetAttrKey(name), child) for name, child in zip(context[0], children, strict=True)], context


def _unflatten(children: Any, context: Any) -> Frame:
    # The leaves may be anything, such as shapes or gradients, so they are not checked.
    present, hints = context
    values: dict[str, Any] = dict.fromkeys((*_NAMES, *_OF_HOSTS)) | dict(zip(present, children, strict=True))
    frame = object.__new__(Frame)
    for name, value in (values | {"hints": Hints(*hints)}).items():
        object.__setattr__(frame, name, value)
    return frame


pytree.register_pytree_node(
    Frame,
    _flatten,
    _unflatten,
    flatten_with_keys_fn=_flatten_with_keys,
    serialized_type_name="mcdenoise.Frame",
    to_dumpable_context=lambda context: [list(context[0]), list(context[1])],
    from_dumpable_context=lambda context: (tuple(context[0]), Hints(*context[1])),
)


def scale_samples(samples: Tensor, factor: Tensor) -> Tensor:
    """Multiply the radiance of samples ``(B, S, C, H, W)`` by a ``(B, 3, H, W)`` factor; keep other channels."""
    return torch.cat([samples[:, :, :3] * factor[:, None], samples[:, :, 3:]], 2)


def part_of_view(view: Tensor, size: tuple[int, int], rows: slice, columns: slice) -> Tensor:
    """Camera matrices ``(..., 4, 4)`` of a rectangle of an image: clip x and y go from -1 to 1 across it."""
    view = view.clone()
    for axis, (pixels, part) in enumerate(zip(size[::-1], (columns, rows), strict=True)):
        start, stop, _ = part.indices(pixels)
        offset = (pixels - 2 * start) / (stop - start) - 1
        view[..., axis] = view[..., axis] * (pixels / (stop - start)) + view[..., 3] * offset
    return view


def _check_like(what: str, value: Tensor, color: Tensor, shape: tuple[int, ...]) -> None:
    if value.device != color.device:
        raise InputError(f"{what}: expected on {color.device} like 'color', found on {value.device}")
    if tuple(value.shape) != shape:
        raise InputError(f"{what}: expected shape {shape} like 'color', found {tuple(value.shape)}")
