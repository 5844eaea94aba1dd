"""The folder of a training run: configuration, data description, progress, and final weights."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import reprlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import torch

from mcdenoise.data.files import atomic_path, json_text, make_folder, write_json, write_text
from mcdenoise.errors import InputError, is_unicode
from mcdenoise.reading import read_bytes, read_text

_SEAL = 32  # bytes of a SHA-256
# Size limits of a log of millions of lines, and of a checkpoint.
_LARGEST = 1 << 34

# The source tree of ``commit`` computed the steps from ``first_step`` on.
Provenance = list[dict[str, Any]]


@dataclass(frozen=True)
class RunFolder:
    """A folder that belongs to one run.

    Args:
        out: the folder.
    """

    out: Path

    def check(self, **identity: Any) -> None:
        """Check that the folder does not belong to another run; write nothing.

        Args:
            identity: contents of each identifying file.

        Raises:
            InputError: an earlier run wrote other contents, or the folder's name is not valid UTF-8.
        """
        # TensorBoard cannot write its events to another.
        if not is_unicode(str(self.out)):
            raise InputError(f"{self.out}: expected a folder whose name is UTF-8; choose another one for the run")
        for name, content in identity.items():
            path = self.out / f"{name}.json"
            if os.path.lexists(path) and (difference := _difference(path, content)):
                raise InputError(f"{path}: {difference}; choose a new folder for a new run")

    def claim(self, **identity: Any) -> None:
        """Write the identity of the run to ``NAME.json``, or check that an earlier run wrote the same.

        Args:
            identity: contents of each identifying file.

        Raises:
            InputError: the folder cannot be written to, or belongs to another run.
        """
        make_folder(self.out)
        self.check(**identity)
        for name, content in identity.items():
            path = self.out / f"{name}.json"
            if not os.path.lexists(path):
                write_json(path, content)

    def save(self, step: int, provenance: Provenance, *parts: Any) -> None:
        """Replace the checkpoint: the number of finished steps, and the states of model, optimizer and scheduler.

        Raises:
            InputError: the file cannot be written; the previous checkpoint is kept.
        """
        states = [part.state_dict() for part in parts]
        content = io.BytesIO()
        torch.save({"step": step, "provenance": provenance, "parts": states}, content)
        # torch.save does not distinguish a full disk from other errors, so serialize to memory and write the bytes
        # here.
        with atomic_path(self._checkpoint) as temporary, temporary.open("wb") as file:
            file.write(content.getbuffer())
            file.write(_sealed(content.getbuffer()))

    def load(self, *parts: Any) -> tuple[int, Provenance]:
        """Restore the state from the checkpoint; return zero steps if there is none.

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
        """Append a line to ``log.jsonl``, which :meth:`rewind` has checked to be a file, if it existed.

        Raises:
            OSError: the file cannot be written.
        """
        with (self.out / "log.jsonl").open("a", encoding="utf-8") as file:
            file.write(json_text(entry) + "\n")

    def errors(self) -> dict[str, float]:
        """The errors of the last validation, NaN for one that is not finite; empty if there was none.

        Raises:
            InputError: the log cannot be read.
        """
        if not (lines := self._lines()):
            raise InputError(f"{self.out / 'log.jsonl'}: expected the log of this run, found no line that can be read")
        measured = [line.validation for _, line in lines if line.validation] or [{}]
        return {name: math.nan if error is None else error for name, error in measured[-1].items()}

    def rewind(self, step: int) -> None:
        """Remove damaged lines, and lines of steps after ``step``, which will be repeated, from ``log.jsonl``.

        Raises:
            InputError: the log cannot be read or written.
        """
        path = self.out / "log.jsonl"
        if os.path.lexists(path):
            write_text(path, "".join(f"{text}\n" for text, line in self._lines() if line.last <= step))

    def _lines(self) -> list[tuple[str, _Line]]:
        """The undamaged lines of the log: others may hold zeros or anything else after a power failure."""
        path, found = self.out / "log.jsonl", []
        try:
            lines = read_bytes(path, _LARGEST).splitlines()
        except OSError as error:
            raise InputError(f"{path}: expected the log of this run, found: {error.strerror}") from error
        for line in lines:
            with suppress(ValueError, RecursionError, msgspec.MsgspecError):
                found.append((line.decode(), msgspec.json.decode(line.decode(), type=_Line)))
        return found

    @property
    def _checkpoint(self) -> Path:
        return self.out / "checkpoint.pt"


def _sealed(content: memoryview) -> bytes:
    """Checksum at the end of a checkpoint, because a single flipped bit would silently change the training."""
    return hashlib.sha256(content).digest()


class _Line(msgspec.Struct):
    """What is read of a line of the log: an entry of finished steps, or of a start."""

    step: float | None = None
    first_step: float = math.inf
    validation: dict[str, float | None] = {}

    @property
    def last(self) -> float:
        """The last finished step, or the first step of a start."""
        return self.first_step if self.step is None else self.step


def _difference(path: Path, content: Any) -> str:
    """The settings of a stored run that are not those of this run, with both values; empty if there are none."""
    try:
        stored = json.loads(read_text(path, _LARGEST))
        # Numbers and tuples as a file has them.
        wanted = json.loads(json_text(content))
        # A run of an earlier version has settings that are gone.
        names = wanted if path.name == "config.json" else {**wanted, **stored}
        other = [name for name in names if stored.get(name) != wanted.get(name)]
        expected, found = (
            ", ".join(f"{name}={reprlib.repr(values.get(name))}" for name in other) for values in (wanted, stored)
        )
        return f"expected {expected} as in this run, found {found}" if other else ""
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return "expected the file of a run, found none that can be read"


def about_weights(
    config: dict[str, Any], identity: dict[str, Any], steps: int, provenance: Provenance, earlier: Sequence[Any] = ()
) -> dict[str, str]:
    """Provenance of weights from a training run, for :func:`mcdenoise.models.save_weights`.

    Args:
        config: contents of ``config.json``.
        identity: contents of ``data.json``.
        steps: number of finished optimiser steps.
        provenance: the commits that computed the steps.
        earlier: data that the first weights were trained on, whose authors are owed credit, too.
    """
    packed = [identity["packed"]] if "packed" in identity else []
    return {
        "config": json.dumps(config),
        "data": json.dumps([*earlier, *identity["sequences"], *packed]),
        "credits": identity["credits"],
        **({"recipe": identity["recipe"]} if "recipe" in identity else {}),
        "initial_weights": identity["initial_weights"],
        "steps": str(steps),
        "commits": json.dumps(provenance),
        "licence": "Apache-2.0",
    }
