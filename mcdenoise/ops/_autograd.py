"""``torch.autograd.Function`` with a typed call, and with rules for forward mode and ``vmap``."""

from __future__ import annotations

import types
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor


class Function(torch.autograd.Function):
    """A function of tensors with one result and derivatives of its own; call it as ``TheFunction.of(*arguments)``.

    Beside ``forward``, ``setup_context`` (which saves for forward mode, too) and ``backward`` it may have a static
    method ``tangent``, with the signature of torch's ``jvp``. Then it also has a rule for ``vmap``, and all its tensors
    and its result must have the batch as their first axis, of images that know nothing of each other: ``vmap`` is a
    larger batch.
    """

    # The same with both rules. The compiler refuses functions that have them, and needs neither.
    _ruled: ClassVar[type[Function]]

    if TYPE_CHECKING:
        # torch leaves `apply` untyped, which a strict type checker takes for an untyped call.
        @classmethod
        def apply(cls, *args: Any) -> Tensor: ...

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls._ruled = cls
        if "tangent" in vars(cls):
            rules = {"jvp": vars(cls)["tangent"], "vmap": classmethod(_larger_batch)}
            cls._ruled = types.new_class(cls.__name__, (cls,), exec_body=lambda body: body.update(rules))

    @classmethod
    def of(cls, *arguments: Any) -> Tensor:
        """The function of these arguments."""
        return (cls if torch.compiler.is_compiling() else cls._ruled).apply(*arguments)


def _larger_batch(
    cls: type[Function], info: Any, in_dims: tuple[int | None, ...], *arguments: Any
) -> tuple[Tensor, int]:
    merged = []
    for argument, dim in zip(arguments, in_dims, strict=True):
        if isinstance(argument, Tensor):
            shape = (info.batch_size, *argument.shape)
            argument = (argument.expand(shape) if dim is None else argument.movedim(dim, 0)).flatten(0, 1)
        merged.append(argument)
    return cls.of(*merged).unflatten(0, (info.batch_size, -1)), 0
