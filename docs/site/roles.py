"""Roles of reStructuredText in docstrings, such as :func:`kernel_conv`, as Markdown."""

from __future__ import annotations

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:func|class|meth|data|mod|attr):`~?([^`]+)`")


class Roles(griffe.Extension):
    """Turns each role into code, which the reader sees as what it is."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of everything that is loaded."""
        if obj.docstring:
            obj.docstring.value = _ROLE.sub(r"`\1`", obj.docstring.value)
