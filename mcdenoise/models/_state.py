"""Checks that a state belongs to the method that receives it, with a message of one line."""

from __future__ import annotations

from typing import Any, NoReturn, TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import State

_Kind = TypeVar("_Kind", bound=tuple[Any, ...])
ADVICE = "hand a method what it returned for the frame before, or None at the beginning of a shot"


def own_state(
    state: State, kind: type[_Kind], frame: Frame, *, channels: int | None = None, keeper: str = ""
) -> _Kind | None:
    """Check that a state has the type that a method keeps; ``None`` passes.

    A state of another image size is not an error but the beginning of a shot, which the method handles.

    Args:
        state: the state that the method received.
        kind: named tuple that the method keeps, defined in the method's file. Its first tensor has the precision in
            which frames are computed.
        frame: the frame that the method received.
        channels: number of channels of that first tensor, if it is fixed.
        keeper: name of the method for the message; by default the file that defines ``kind``.

    Raises:
        InputError: type, device, batch, precision or number of channels do not match.
    """
    if state is None:
        return None
    keeper = keeper or _file_of(kind)
    if type(state) is not kind:
        raise _foreign(f"what {keeper} keeps of a frame", state)
    # An exported graph has its own state, for any batch size.
    if not torch.compiler.is_compiling():
        _check_tensors(state, keeper, frame, channels)
    return state


def own_pair(state: State, keeper: str) -> tuple[State, State]:
    """Unpack a wrapper's state: its own part and the part of the method inside.

    Args:
        state: the state that the wrapper received; ``None`` stands for two parts that are ``None``.
        keeper: name of the wrapper for the message.

    Raises:
        InputError: the state is not a pair.
    """
    if state is None:
        return None, None
    if type(state) not in (tuple, list) or len(state) != 2:
        raise _foreign(f"what {keeper} keeps of a frame and what the method inside keeps", state)
    return state[0], state[1]


def own_parts(state: State, names: tuple[str, ...]) -> dict[str, State]:
    """Unpack a state by part name; ``None`` stands for parts that are ``None``.

    Raises:
        InputError: the parts have other names.
    """
    if state is None:
        return dict.fromkeys(names)
    if not isinstance(state, dict) or set(state) != set(names):
        raise _foreign(f"what each of {', '.join(names)} keeps of a frame", state)
    return dict(state)


def _foreign(expected: str, state: State) -> InputError:
    return InputError(f"state: expected {expected}, found {_described(state)}; {ADVICE}")


def _check_tensors(state: State, keeper: str, frame: Frame, channels: int | None) -> None:
    color = frame.color

    def refuse(expected: str, found: str) -> NoReturn:
        raise InputError(f"state: expected what {keeper} keeps {expected}, found {found}; {ADVICE}")

    tensors = [leaf for leaf in pytree.tree_leaves(state) if leaf is not None]
    if not tensors:
        refuse("of a frame", "it without a tensor")
    for leaf in tensors:
        if not isinstance(leaf, Tensor):
            refuse("in tensors", type(leaf).__name__)
        if leaf.device != color.device:
            refuse(f"on {color.device} like 'color'", f"it on {leaf.device}")
        if leaf.shape[:1] != color.shape[:1]:
            count = len(leaf) if leaf.dim() else "none"
            refuse(f"of a batch of {len(color)} like 'color'", f"it of {count} (reset the denoiser)")
    first = tensors[0]
    if (first.dtype == torch.float64) != (color.dtype == torch.float64):
        refuse(f"of frames of {color.dtype}", f"it of frames of {first.dtype}")
    if channels is not None and first.shape[1] != channels:
        refuse(f"in {channels} channels", f"{first.shape[1]}: of another method, other settings or other layers")


def _file_of(kind: type) -> str:
    """The file of the method, such as "svgf"."""
    return kind.__module__.rpartition(".")[2].lstrip("_")


def _described(state: State) -> str:
    """Name the method that a state belongs to, as far as its type tells."""
    if isinstance(state, dict):
        return f"what each of {', '.join(map(str, state)) or 'nothing'} keeps"
    if hasattr(state, "_fields"):
        return f"what {_file_of(type(state))} keeps"
    if isinstance(state, tuple | list):
        return f"({', '.join(map(_described, state))})"
    return "None" if state is None else type(state).__name__
