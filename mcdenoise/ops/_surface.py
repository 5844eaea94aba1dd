"""The buffers that tell one surface from another in two frames."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from mcdenoise.ops._check import check_shapes


class Surface(NamedTuple):
    """The buffers that tell one surface from another; each ``(B, C, H, W)`` or ``None``.

    Args:
        position: ``(B, 3, H, W)`` world-space hit points, scene units.
        normal: ``(B, 3, H, W)`` world-space unit normals.
        depth: ``(B, 1, H, W)`` distance along the view axis, scene units, ``inf`` where nothing was hit.
        label: ``(B, 1, H, W)`` a number for each object, such as its index.
    """

    position: Tensor | None = None
    normal: Tensor | None = None
    depth: Tensor | None = None
    label: Tensor | None = None


def comparable(surface: Surface | None, previous: Surface | None) -> tuple[Surface, Surface]:
    """Both surfaces, reduced to what both have and free of gradients."""
    if surface is None or previous is None:
        return Surface(), Surface()
    pairs = [
        (None, None) if a is None or b is None else (a.detach(), b.detach())
        for a, b in zip(surface, previous, strict=True)
    ]
    return Surface(*(a for a, _ in pairs)), Surface(*(b for _, b in pairs))


def check_surfaces(previous: Tensor, surface: Surface | None, previous_surface: Surface | None) -> None:
    """``TypeError`` or ``ValueError`` for surfaces that cannot be compared."""
    if surface is None or previous_surface is None:
        return
    here, there = comparable(surface, previous_surface)
    for name, channels, a, b in zip(Surface._fields, (3, 3, 1, 1), here, there, strict=True):
        if a is not None and b is not None:
            check_shapes(
                previous=(previous, "B C H W"),
                **{f"surface.{name}": (a, f"B {channels} H W"), f"previous_surface.{name}": (b, f"B {channels} H W")},
            )
    if here.position is not None and here.depth is None:
        raise ValueError("surface.depth: expected it beside position in both frames, found None")
