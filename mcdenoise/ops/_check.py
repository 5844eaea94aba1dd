"""Checks at the door of every op: shapes by named axes, and settings."""

from __future__ import annotations

from torch import Tensor


def check_shapes(**arguments: tuple[Tensor | None, str]) -> dict[str, int]:
    """Check shapes against named axes and bind the names across all arguments.

    Args:
        arguments: for each name a tensor and its axes, such as ``image=(image, "B C H W")``. An axis that is a number
            must have that size; an axis that is a name must have the same size wherever the name appears. Of axes in
            brackets, ``"[B C H W]"``, the tensor may be ``None``.

    Returns:
        The size of every named axis.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: a rank or a size does not fit; the message names the argument, and the expected and the found shape.
    """
    sizes: dict[str, int] = {}
    owner: dict[str, str] = {}
    for name, (tensor, axes_of) in arguments.items():
        layout = axes_of.strip("[]")
        if tensor is None and layout != axes_of:
            continue
        if not isinstance(tensor, Tensor):
            raise TypeError(f"{name}: expected a torch.Tensor, found {type(tensor).__name__}")
        if not tensor.is_floating_point():
            raise TypeError(f"{name}: expected a floating-point dtype, found {tensor.dtype}")
        axes = layout.split()
        if tensor.ndim != len(axes):
            raise ValueError(f"{name}: expected shape ({', '.join(axes)}), found {tuple(tensor.shape)}")
        for axis, size in zip(axes, tensor.shape, strict=True):
            if axis.isdigit():
                if size != int(axis):
                    raise ValueError(f"{name}: expected shape ({', '.join(axes)}), found {tuple(tensor.shape)}")
            elif axis not in sizes:
                sizes[axis], owner[axis] = size, name
            elif sizes[axis] != size:
                raise ValueError(
                    f"{name}: expected {axis} = {sizes[axis]} as in {owner[axis]}, "
                    f"found {size} (shape {tuple(tensor.shape)}, layout {layout})"
                )
    return sizes


def check_half(name: str, image: Tensor, size: tuple[int, int]) -> None:
    """``ValueError`` for an image that has not half of the height and width, rounded up."""
    expected, found = tuple((side + 1) // 2 for side in size), tuple(image.shape[-2:])
    if found != expected:
        raise ValueError(f"{name}: expected height and width {expected} for size {size}, found {found}")


def check_least(least: float, **settings: float) -> None:
    """``ValueError`` for a setting that is smaller, or NaN."""
    for name, value in settings.items():
        if not value >= least:
            raise ValueError(f"{name}: expected at least {least}, found {value}")


def check_positive(**settings: float) -> None:
    """``ValueError`` for a setting that is not above 0."""
    for name, value in settings.items():
        if not value > 0:
            raise ValueError(f"{name}: expected a positive number, found {value}")


def check_kernel_size(kernel_size: int, least: int = 1) -> None:
    """``ValueError`` for a side of a window that is even, or smaller."""
    if kernel_size < least or kernel_size % 2 == 0:
        raise ValueError(f"kernel_size: expected odd and at least {least}, found {kernel_size}")
