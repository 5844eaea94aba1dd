"""A frame before its method: valid, filled, in the precision of the model; and what the model's errors mean."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import nn

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models import Model, Note
from mcdenoise.models._interface import at_hand
from mcdenoise.models._layers import closed
from mcdenoise.models._report import FrameReport
from mcdenoise.models._void import Void, without_void


def prepared(frame: Frame, report: FrameReport, doubt: Callable[[str], None]) -> tuple[Frame, Void]:
    """The frame with valid values, void pixels filled, and layers that sum to its color.

    Args:
        frame: on the device. An invalid one raises an error, on a GPU only when the numbers have arrived.
        report: gets the repairs.
        doubt: warns of a text, unless that is empty.
    """
    frame, void = without_void(frame)
    if void.mask is not None:
        report.add([Note("void", "filled from around, and kept")])
    if at_hand(frame.color.device):
        frame, report.repairs = frame.inspect()
        doubt(report.repairs.doubt)
    else:
        frame, numbers, judge = frame.repaired()

        def tell(found: Sequence[float]) -> None:
            report.repairs = judge(found)
            doubt(report.repairs.doubt)

        report.ask(numbers, tell)
    return closed(frame.with_depth(), report.ask), void


def dtype_of(frame: Frame, model: Model, *, differentiable: bool) -> torch.dtype:
    """The dtype that a frame is computed in: float64 if it and all weights are, for derivatives."""
    exact = differentiable and frame.color.dtype == torch.float64
    return torch.float64 if exact and _dtypes(model) <= {torch.float64} else torch.float32


@contextmanager
def explained(model: Model, dtype: torch.dtype) -> Iterator[None]:
    """Add an explanation to the error of a model whose weights have another precision than its frame."""
    try:
        yield
    except RuntimeError as error:
        others = ", ".join(sorted(str(each).removeprefix("torch.") for each in _dtypes(model) - {dtype}))
        if not others:
            raise
        raise InputError(
            f"model: expected float32 weights for float32 frames, found {others} weights, with which it fails "
            f"({' '.join(str(error).split())}); call its float(), or pass float64 frames, all weights being float64, "
            "with differentiable"
        ) from error


def _dtypes(model: Model) -> set[torch.dtype]:
    """Those of a model's weights."""
    return {each.dtype for each in model.parameters()} if isinstance(model, nn.Module) else set()
