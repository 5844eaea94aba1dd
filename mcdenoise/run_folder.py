"""The folder of a training run: what is trained on what, how far it is, and the weights at the end."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from mcdenoise.data.files import atomic_path, write_text
from mcdenoise.errors import InputError

# Steps from ``first_step`` on were computed by the source tree of ``commit``.
Provenance = list[dict[str, Any]]


@dataclass(frozen=True)
class RunFolder:
    """A folder that belongs to one run.

    Args:
        out: the folder.
    """

    out: Path

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
        for name, content in identity.items():
            path = self.out / f"{name}.json"
            text = json.dumps(content, indent=2) + "\n"
            if not path.exists():
                write_text(path, text)
            elif not path.is_file() or path.read_bytes() != text.encode():
                raise InputError(
                    f"{path}: expected the same as in this run, found another; choose a new folder for a new run"
                )

    def save(self, step: int, provenance: Provenance, *parts: Any) -> None:
        """Replace the checkpoint: the number of steps done, and the states of model, optimizer and scheduler."""
        states = [part.state_dict() for part in parts]
        with atomic_path(self._checkpoint) as temporary:
            torch.save({"step": step, "provenance": provenance, "parts": states}, temporary)

    def load(self, *parts: Any) -> tuple[int, Provenance]:
        """Restore what :meth:`save` saved; zero steps without a checkpoint.

        Raises:
            InputError: the checkpoint cannot be loaded.
        """
        if not self._checkpoint.exists():
            return 0, []
        try:
            saved = torch.load(self._checkpoint, map_location="cpu", weights_only=True)
            for part, state in zip(parts, saved["parts"], strict=True):
                part.load_state_dict(state)
            return int(saved["step"]), list(saved["provenance"])
        except Exception as error:
            raise InputError(
                f"{self._checkpoint}: expected a checkpoint of this run, found one that cannot be loaded; "
                "remove it to start again"
            ) from error

    def log(self, entry: dict[str, Any]) -> None:
        """Append a line to ``log.jsonl``."""
        with (self.out / "log.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    @property
    def _checkpoint(self) -> Path:
        return self.out / "checkpoint.pt"


def source_commit() -> str:
    """The commit of the source tree, with ``-dirty`` where files differ from it; ``"unknown"`` outside a checkout."""
    source = Path(__file__)
    try:
        # An installed package may lie inside somebody else's checkout.
        _git(source.parent, "ls-files", "--error-unmatch", source.name)
        return _git(source.parent, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
