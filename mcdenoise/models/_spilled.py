"""Images whose memory is a file, for frames of which not all fit: their pages are read when they are used."""

from __future__ import annotations

import math
import mmap
import os
import tempfile
import weakref
from collections.abc import Sequence

import torch
from torch import Tensor

from mcdenoise.errors import InputError

# Values; smaller tensors stay in memory, and larger ones are copied in pieces of this size.
_LEAST = 1 << 22
# Not every system can reserve room for a file, and drop its pages.
CAN_SPILL = hasattr(os, "posix_fallocate") and hasattr(mmap, "MADV_DONTNEED")
# Addresses of the files in memory.
_mapped: weakref.WeakKeyDictionary[mmap.mmap, int] = weakref.WeakKeyDictionary()


def spilled(tensor: Tensor) -> Tensor:
    """The same values in a temporary file, which goes with the tensor; a small tensor is returned as it is.

    Raises:
        InputError: the folder of temporary files has no room.
    """
    if tensor.numel() < _LEAST or is_spilled(tensor):
        return tensor
    result = empty_spilled(tensor.shape, tensor.dtype)
    step = max(_LEAST * tensor.shape[-2] // tensor.numel(), 1)
    for top in range(0, tensor.shape[-2], step):
        result[..., top : top + step, :] = tensor[..., top : top + step, :]
        drop_pages()
    return result


def is_spilled(tensor: Tensor) -> bool:
    """Whether the tensor is in a file, all of it or a part of another."""
    return tensor.untyped_storage().data_ptr() in _mapped.values()


def empty_spilled(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """A tensor of zeros in a temporary file, which goes with the tensor.

    Raises:
        InputError: the folder of temporary files has no room.
    """
    size = math.prod(shape) * dtype.itemsize
    try:
        with tempfile.TemporaryFile() as file:
            # Now, because later a full disk would end the process without a word.
            os.posix_fallocate(file.fileno(), 0, size)
            pages = mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise InputError(
            f"{tempfile.gettempdir()}: expected {size / 1e9:.2g} GB of room for a history that does not fit into "
            f"max_memory ({error.strerror}); free some, or name another folder by TMPDIR"
        ) from error
    result = torch.frombuffer(pages, dtype=dtype)
    _mapped[pages] = result.data_ptr()
    return result.view(*shape)


def drop_pages() -> None:
    """Give back the memory of all tensors that are in files; their values stay in the files."""
    for pages in list(_mapped):
        pages.madvise(mmap.MADV_DONTNEED)
