"""The folder of a training run: what is trained on what, how far it is, and the weights at the end."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from mcdenoise.data.files import atomic_path, held, write_text
from mcdenoise.errors import InputError, is_unicode
from mcdenoise.reading import read_bytes, read_text

_SEAL = 32  # bytes of a SHA-256
# Bytes of a log of millions of lines, or of a checkpoint.
_LARGEST = 1 << 34

# Steps from ``first_step`` on were computed by the source tree of ``commit``.
Provenance = list[dict[str, Any]]


@dataclass(frozen=True)
class RunFolder:
    """A folder that belongs to one run.

    Args:
        out: the folder.
    """

    out: Path

    def check(self, **identity: Any) -> None:
        """See that no other run has the folder; write nothing.

        Args:
            identity: for each file its content.

        Raises:
            InputError: an earlier run wrote something else to one of the files, or the folder's name is not UTF-8.
        """
        # TensorBoard cannot write its events to another.
        if not is_unicode(str(self.out)):
            raise InputError(f"{self.out}: expected a folder whose name is UTF-8; choose another one for the run")
        for name, content in identity.items():
            path = self.out / f"{name}.json"
            if os.path.lexists(path) and (not path.is_file() or path.read_bytes() != _json(content).encode()):
                raise InputError(
                    f"{path}: expected the same as in this run, found another; choose a new folder for a new run"
                )

    def claim(self, **identity: Any) -> None:
        """Write what identifies the run to ``NAME.json``, or check that an earlier run did just that.

        Args:
            identity: for each file its content.

        Raises:
            InputError: the folder cannot be written to, or belongs to another run.
        """
        try:
            self.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.out}: expected a folder to write the run to: {error.strerror}") from error
        self.check(**identity)
        for name, content in identity.items():
            path = self.out / f"{name}.json"
            if not os.path.lexists(path):
                write_text(path, _json(content))

    def held(self) -> AbstractContextManager[None]:
        """Have the folder for oneself; that ends with the process, however that ends.

        Raises:
            InputError: another process has it, which the message names.
        """
        return held(self.out, "training")

    def save(self, step: int, provenance: Provenance, *parts: Any) -> None:
        """Replace the checkpoint: the number of steps done, and the states of model, optimizer and scheduler.

        Raises:
            InputError: it cannot be written; the one before is kept.
        """
        states = [part.state_dict() for part in parts]
        content = io.BytesIO()
        torch.save({"step": step, "provenance": provenance, "parts": states}, content)
        # Not by torch itself, which does not say that a disk is full in a way that could be told from other failures.
        with atomic_path(self._checkpoint) as temporary, temporary.open("wb") as file:
            file.write(content.getbuffer())
            file.write(_sealed(content.getbuffer()))

    def checkpointed(self) -> int:
        """When the checkpoint was written, in nanoseconds since 1970; 0 without one."""
        try:
            return self._checkpoint.stat().st_mtime_ns
        except OSError:
            return 0

    def load(self, *parts: Any) -> tuple[int, Provenance]:
        """Restore what :meth:`save` saved; zero steps without a checkpoint.

        Raises:
            InputError: the checkpoint cannot be loaded.
        """
        if not os.path.lexists(self._checkpoint):
            return 0, []
        try:
            content = memoryview(read_bytes(self._checkpoint, _LARGEST))
            content, seal = content[:-_SEAL], content[-_SEAL:]
            if seal != _sealed(content):
                raise ValueError("expected the checksum of the content behind it, found another")
            saved = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
            for part, state in zip(parts, saved["parts"], strict=True):
                part.load_state_dict(state)
            return int(saved["step"]), list(saved["provenance"])
        except Exception as error:
            raise InputError(
                f"{self._checkpoint}: expected a checkpoint of this run, found one that is damaged or of another; "
                "remove it to start again"
            ) from error

    def log(self, entry: dict[str, Any]) -> None:
        """Append a line to ``log.jsonl``, which :meth:`rewind` has seen to be a file, if there was one.

        Raises:
            OSError: it cannot be written.
        """
        with (self.out / "log.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    def errors(self) -> dict[str, float]:
        """The errors of the last validation; none without one.

        Raises:
            InputError: the log cannot be read.
        """
        path = self.out / "log.jsonl"
        try:
            entries = [json.loads(line) for line in read_text(path, _LARGEST).splitlines()]
            measured = [entry["validation"] for entry in entries if entry.get("validation")]
            return {str(name): float(error) for name, error in measured[-1].items()} if measured else {}
        except (OSError, ValueError, AttributeError, TypeError, RecursionError) as error:
            raise InputError(f"{path}: expected the log of this run, found none that can be read") from error

    def rewind(self, step: int) -> None:
        """Drop from ``log.jsonl`` what will be computed again, steps after ``step``, and lines that are damaged.

        One may be cut off in writing; others hold zeros, or anything, after a power cut.

        Raises:
            InputError: the log cannot be read or written.
        """
        path = self.out / "log.jsonl"
        if not os.path.lexists(path):
            return
        try:
            lines = read_bytes(path, _LARGEST).splitlines()
        except OSError as error:
            raise InputError(f"{path}: expected the log of this run, found: {error.strerror}; remove it") from error
        write_text(path, "".join(f"{line.decode()}\n" for line in lines if _last_step(line) <= step))

    @property
    def _checkpoint(self) -> Path:
        return self.out / "checkpoint.pt"


def _sealed(content: memoryview) -> bytes:
    """The checksum of a checkpoint, which stands behind it: one flipped bit would train other weights."""
    return hashlib.sha256(content).digest()


def _last_step(line: bytes) -> float:
    """The step that a line of the log is about, the first that a start is about; infinity where it is damaged."""
    try:
        entry = json.loads(line.decode())
        return float(entry.get("step", entry.get("first_step", math.inf)))
    except (ValueError, AttributeError, TypeError, RecursionError, OverflowError):
        return math.inf


def _json(content: Any) -> str:
    return json.dumps(content, indent=2) + "\n"


def about_weights(
    config: dict[str, Any], identity: dict[str, Any], steps: int, provenance: Provenance
) -> dict[str, str]:
    """What weights say of the run that they come from, for :func:`mcdenoise.models.save_weights`.

    Args:
        config: what ``config.json`` holds.
        identity: what ``data.json`` holds.
        steps: optimiser steps done.
        provenance: of the steps.
    """
    return {
        "config": json.dumps(config),
        "data": json.dumps(identity["sequences"]),
        "credits": identity["credits"],
        **({"recipe": identity["recipe"]} if "recipe" in identity else {}),
        "initial_weights": identity["initial_weights"],
        "steps": str(steps),
        "commits": json.dumps(provenance),
        "licence": "Apache-2.0",
    }
