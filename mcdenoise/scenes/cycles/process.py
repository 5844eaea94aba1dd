"""Blender in a separate process, because of its license, its size, and its required version of Python."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO, Any

from mcdenoise.errors import InputError

PYTHON_VARIABLE = "BLENDER_PYTHON"
_SCRIPT = Path(__file__).with_name("blender.py")
_LAST_WORDS = 2000


class Blender:
    """A running Blender that builds scenes and renders their frames; a context manager, started once for many scenes.

    Args:
        python: an interpreter that can import ``bpy``; by default that of the environment variable
            ``BLENDER_PYTHON``, or else this one.

    ``version`` is that of Blender.

    Raises:
        InputError: the interpreter does not exist, or has no ``bpy``.
    """

    def __init__(self, python: Path | None = None) -> None:
        python = python or Path(os.environ.get(PYTHON_VARIABLE, sys.executable))
        self._said: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - closed by close()
        try:
            self._process = subprocess.Popen(
                # -P: do not import the modules beside the script.
                [str(python), "-P", str(_SCRIPT)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._said,
                encoding="utf-8",
            )
        except OSError as error:
            self._said.close()
            raise InputError(
                f"{python}: expected a Python that has Blender's module bpy, found nothing that runs "
                f"({error.strerror}); name one by {PYTHON_VARIABLE}"
            ) from error
        answer = self._answer()
        if "ok" not in answer:
            self.close()
            raise InputError(
                f"{python}: expected a Python that has Blender's module bpy, found none "
                f"({answer['error']}); pip install bpy==4.5.15 into a Python 3.11 and name it by {PYTHON_VARIABLE}"
            )
        self.version: str = answer["ok"]

    def __enter__(self) -> Blender:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def ask(self, do: str, **arguments: Any) -> None:
        """Send a command to ``blender.py`` and wait until it is done.

        Raises:
            InputError: the command failed, or Blender died.
        """
        try:
            assert self._process.stdin is not None
            self._process.stdin.write(json.dumps({"do": do, **arguments}) + "\n")
            self._process.stdin.flush()
            answer = self._answer()
        except BrokenPipeError:
            answer = {"error": self._last_words()}
        if "ok" not in answer:
            raise InputError(f"Blender could not do '{do}': {answer['error']}")

    def close(self) -> None:
        """End the process."""
        try:
            self._process.communicate(timeout=20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
        self._said.close()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._process.wait()
            return {"error": self._last_words()}
        answer: dict[str, Any] = json.loads(line)
        return answer

    def _last_words(self) -> str:
        size = self._said.seek(0, 2)
        self._said.seek(max(size - _LAST_WORDS, 0))
        lines = [line for line in self._said.read().decode(errors="replace").splitlines() if line.strip()]
        return lines[-1].strip() if lines else "it ended without a word"
