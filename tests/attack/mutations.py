"""Damage to files, by seed, and replacements of files."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from data.damage import flipped, flipped_header, noise, spliced, truncated
from refusals import put_no_file

Generator = np.random.Generator


def zeroed(g: Generator, content: bytes) -> bytes:
    """Replace a range by zeros, as after a power failure."""
    start = int(g.integers(0, len(content)))
    length = int(g.integers(1, 1 + max(1, len(content) // 2)))
    return content[:start] + bytes(min(length, len(content) - start)) + content[start + length :]


TOKENS = [b"NaN", b"1e999", b"-1", b"null", b"[" * 3000, b'{"a":' * 3000, b'"', b"\xff", b"\0", b"{}", b"9" * 400]
TOKENS += [b"true", b"[]", b"0", b"\n", b"//", b"/*", b";", b"Infinity", b"\x1b[2J", b"\\ud800", b"9" * 5000]


def replaced_token(g: Generator, content: bytes) -> bytes:
    """Replace some bytes by an unusual value or token."""
    start, end = sorted(int(each) for each in g.integers(0, len(content) + 1, 2))
    end = min(end, start + int(g.integers(0, 20)))
    return content[:start] + TOKENS[int(g.integers(0, len(TOKENS)))] + content[end:]


def other_value(g: Generator, content: bytes) -> bytes:
    """Replace one word or number of a text by another value, so that the text may still parse."""
    words = list(re.finditer(rb'"[^"]*"|-?[0-9][0-9.e+-]*|true|false|null', content))
    if not words:
        return flipped(g, content)
    word = words[int(g.integers(0, len(words)))]
    values = b'null -1 0 1e300 "x" [] {} true 123456789012345678901 0.5 "\\ud800"'.split()
    return content[: word.start()] + values[int(g.integers(0, len(values)))] + content[word.end() :]


DAMAGES: tuple[Callable[[Generator, bytes], bytes], ...] = (
    *(truncated, zeroed, flipped, flipped_header, spliced, replaced_token, other_value, flipped, noise),
)


def put(what: str) -> Callable[[Path], None]:
    def at(path: Path) -> None:
        put_no_file(what, path)

    at.__name__ = f"put_{what}"
    return at


# Replacements of a file; they do not depend on a seed.
PLACES = tuple(map(put, ("folder", "pipe", "link", "loop", "device", "empty", "nothing")))
