"""The filter that kernel convolution, splat and cross-bilateral filter are forms of, by backend."""

from __future__ import annotations

from typing import Any


def filter_of(backend: str) -> Any:
    """The module that computes on a backend: ``filtered``, ``splatted`` and ``derivatives``."""
    if backend == "triton":
        from mcdenoise.ops._fast import _triton_filter

        return _triton_filter
    from mcdenoise.ops._fast import _numba_filter

    return _numba_filter
