"""Ways in which files are damaged, seeded, and a process that reads them with little memory and says what it found."""

import json
import struct
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

Generator = np.random.Generator
WORKER = Path(__file__).with_name("fuzz_worker.py")
SECONDS_A_FILE = 1.0


def truncated(g: Generator, content: bytes) -> bytes:
    return content[: int(g.integers(0, len(content)))]


def flipped(g: Generator, content: bytes, end: int | None = None) -> bytes:
    damaged = bytearray(content)
    for _ in range(int(g.integers(1, 9))):
        damaged[int(g.integers(0, min(end or len(content), len(content))))] ^= 1 << int(g.integers(0, 8))
    return bytes(damaged)


def flipped_header(g: Generator, content: bytes) -> bytes:
    return flipped(g, content, 400)


def spliced(g: Generator, content: bytes) -> bytes:
    """A piece replaced by one from elsewhere in the file, longer or shorter."""
    start, source = (int(g.integers(0, len(content))) for _ in range(2))
    length, taken = (int(g.integers(0, 64)) for _ in range(2))
    return content[:start] + content[source : source + taken] + content[start + length :]


def numbers(g: Generator, content: bytes) -> bytes:
    """A few aligned-or-not numbers replaced by the largest, the smallest, minus one and so on."""
    extremes = (-1, 0, 1, 2**31 - 1, -(2**31), 2**28, 2**16, 2**14 - 1)
    damaged = bytearray(content)
    for _ in range(int(g.integers(1, 4))):
        start = int(g.integers(0, min(len(content), 600) - 4))
        struct.pack_into("<i", damaged, start, extremes[int(g.integers(0, len(extremes)))])
    return bytes(damaged)


def attribute(content: bytes, name: bytes, kind: bytes, value: bytes) -> bytes:
    """The file with another value of the same size for a header attribute."""
    start = content.find(name + b"\0" + kind + b"\0")
    if start < 0:
        return content
    start += len(name) + len(kind) + 2
    (length,) = struct.unpack_from("<i", content, start)
    return content[: start + 4] + value[:length] + content[start + 4 + length :]


def absurd_size(g: Generator, content: bytes) -> bytes:
    """A header that speaks of up to 2^31 pixels a side, or of fewer than none."""
    corners = [int(2.0 ** g.uniform(0, 31) * g.choice([1, 1, 1, -1])) for _ in range(4)]
    if g.random() < 0.5:
        corners = [0, 0, 2 ** int(g.integers(4, 15)) - 1, 2 ** int(g.integers(4, 15)) - 1]
    window = struct.pack("<4i", *(max(-(2**31), min(corner, 2**31 - 1)) for corner in corners))
    content = attribute(content, b"dataWindow", b"box2i", window)
    return attribute(content, b"displayWindow", b"box2i", window)


def channel_types(g: Generator, content: bytes) -> bytes:
    """Other pixel types, samplings and names in the list of channels than in the data."""
    start = content.find(b"channels\0chlist\0")
    (length,) = struct.unpack_from("<i", content, start + 16)
    damaged = bytearray(content)
    for _ in range(int(g.integers(1, 6))):
        damaged[start + 20 + int(g.integers(0, length))] = int(g.choice([0, 1, 2, 3, 255, int(g.integers(0, 256))]))
    return bytes(damaged)


def noise(g: Generator, content: bytes) -> bytes:
    """Nothing but the first bytes is that of an EXR."""
    return content[: int(g.integers(0, 12))] + g.bytes(int(g.integers(0, 2000)))


DAMAGES: tuple[Callable[[Generator, bytes], bytes], ...] = (
    *(truncated, flipped, flipped_header, spliced, numbers, absurd_size, channel_types, noise),
)


def outcomes(folder: Path, files: Mapping[str, bytes], written: Path) -> dict[str, str]:
    """What the reader made of each file, which is then written as a shot; effects on the process are asserted."""
    folder.mkdir()
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return outcomes_of(folder, written)


def outcomes_of(folder: Path, written: Path) -> dict[str, str]:
    """Return what the reader made of each file of a folder, see :func:`outcomes`."""
    names = {path.name for path in folder.iterdir()}
    written.mkdir()
    # Loading the libraries takes some seconds on a busy machine.
    limit = 60 + SECONDS_A_FILE * len(names)
    arguments = [sys.executable, WORKER, folder, written]
    try:
        run = subprocess.run(arguments, capture_output=True, text=True, timeout=limit, check=False)
    except subprocess.TimeoutExpired as error:
        last = (error.stdout or b"").decode().splitlines()[-1]
        raise AssertionError(f"still reading after {limit} s: {last}") from None
    lines = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("{")]
    assert run.returncode == 0, (
        f"exit status {run.returncode} at {lines[-1] if lines else 'the start'}: {run.stderr[-2000:]}"
    )
    found = {line["file"]: line["outcome"] for line in lines if "file" in line}
    assert found.keys() == names
    return found


def assert_clear(folder: Path, found: Mapping[str, str]) -> None:
    """One line for each that was refused, which names the file and has no characters that a terminal would obey."""
    for name, outcome in found.items():
        assert not outcome.startswith("!"), f"{name}: {outcome}"
        assert outcome.isprintable(), f"{name}: {outcome!r}"
        # Refused before it is asked for: on a larger machine it would be granted.
        assert "not enough memory" not in outcome, f"{name}: {outcome}"
        assert not outcome or str(folder / name) in outcome, f"{name}: {outcome}"
        assert len(outcome) < 600 + len(str(folder)), f"{name}: {outcome}"
