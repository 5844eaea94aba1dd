"""Parsing of methods given as text: ``name``, ``name(setting=value, ...)``, a weights file, or a user's factory."""

from __future__ import annotations

import ast
import inspect
import itertools
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.models._registry import find_model
from mcdenoise.models._weights import has_random_weights, model_of

WEIGHTS = ".safetensors"
# A name or path, optionally followed by settings in parentheses.
_SPELLING = re.compile(r"(?P<name>[^()]+|.+?)(?:\((?P<settings>[^()]*)\))?", re.DOTALL)


@dataclass(frozen=True)
class Spelling:
    """A parsed method.

    Args:
        model: name in the zoo, or ``path/to/file.py:factory``, or ``package.module:factory``.
        weights: weights file that replaces the shipped weights.
        settings: arguments for the model's constructor.
    """

    model: str
    weights: Path | None = None
    settings: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Short name for tables: settings as given, files without folders."""
        name = self.model if self.weights is None else self.weights.stem
        if ":" in name:
            path, _, factory = name.rpartition(":")
            name = f"{Path(path).name}:{factory}"
        settings = ", ".join(f"{setting}={value}" for setting, value in self.settings.items())
        return f"{name}({settings})" if settings else name

    @property
    def doubt(self) -> str:
        """A warning if the model is the user's own and has random weights; otherwise empty."""
        if self.weights is not None or not has_random_weights(self.model, self.settings):
            return ""
        return (
            f"model '{self.model}': its weights are random, and others in each run; train it, and name their file, as "
            f"'{self.model}(weights=FILE)', or let its factory load them"
        )

    def takes(self, setting: str) -> bool:
        """Whether the model's constructor has such a setting."""
        return setting in inspect.signature(find_model(self.model).construct).parameters

    def denoiser(self, **options: Any) -> Denoiser:
        """A denoiser with this method.

        Args:
            options: arguments of :class:`mcdenoise.denoiser.Denoiser`, and settings in addition to the parsed ones.

        Raises:
            InputError: see :class:`mcdenoise.denoiser.Denoiser`.
        """
        return Denoiser(self.model, weights=self.weights, **{**options, **self.settings})


def parse_method(text: str) -> Spelling:
    """Parse a method.

    Args:
        text: such as ``"wild(alpha_min=0.2)"``, ``"oidn(quality=fast)"``, ``"run/wild.safetensors"``,
            ``"mine.py:make"`` or, with weights, ``"mine.py:make(weights=run/make.safetensors)"``. Values are numbers,
            ``True``, ``False``, ``None``, or unquoted strings.

    Raises:
        InputError: the text has another form, or a weights file that is named alone cannot be read, or is for a model
            that is not registered.

    Example:
        >>> parse_method("joint_bilateral(sigma_color=0.1, sigma_space=4)").settings
        {'sigma_color': 0.1, 'sigma_space': 4}
    """
    match = _SPELLING.fullmatch(text.strip())
    if match is None:
        raise InputError(f"method '{text}': expected a name, or name(setting=value, ...), found neither")
    settings: dict[str, Any] = {}
    name = match["name"].strip()
    opened = name.rpartition(":")[2]
    if "(" in opened and ")" not in opened and not name.endswith(WEIGHTS):
        raise InputError(f"method '{text}': expected ')' after the settings, found none; add it")
    for part in match["settings"].split(",") if (match["settings"] or "").strip() else []:
        setting, equals, value = (each.strip() for each in part.partition("="))
        if not (setting.isidentifier() and equals and value) or setting in settings:
            raise InputError(f"method '{text}': expected settings such as (setting=value), found '{part.strip()}'")
        settings[setting] = value if setting == "weights" else _value(value)
    if not name.endswith(WEIGHTS):
        weights = settings.pop("weights", None)
        return Spelling(name, weights if weights is None else Path(weights), settings)
    return Spelling(model_of(Path(name)), Path(name), settings)


def check_names_no_code(text: str, where: str) -> None:
    """Check that a method, which a file names, is a model of the zoo or a weights file, and no code of a user.

    Raises:
        InputError: it names a factory.
    """
    match = _SPELLING.fullmatch(text.strip())
    name = "" if match is None else match["name"].strip()
    if ":" in name and not name.endswith(WEIGHTS):
        raise InputError(
            f"{where}: expected a model that `mcdenoise models` lists, or a weights file, found '{name}'; a file names "
            "no code to run: leave it out, and name your own model on the command line (--model)"
        )


def split_methods(text: str) -> list[str]:
    """Split methods at commas, and expand alternatives to all combinations.

    Args:
        text: such as ``"noisy,oidn(quality=fast|high, source=raw)"``.

    Raises:
        InputError: a method is empty, or given twice.

    Example:
        >>> split_methods("noisy, oidn(quality=fast|high,source=raw)")
        ['noisy', 'oidn(quality=fast,source=raw)', 'oidn(quality=high,source=raw)']
    """
    found: list[str] = []
    for part in re.split(r",(?![^(]*\))", text):
        # Every second part is a list of alternatives.
        pieces = re.split(r"(?<==)([^,=()]*\|[^,=()]*)(?=[,)])", part.strip())
        choices = [[piece] for piece in pieces]
        choices[1::2] = [[each.strip() for each in piece.split("|")] for piece in pieces[1::2]]
        found += map("".join, itertools.product(*choices))
    if "" in found or len(set(found)) < len(found):
        raise InputError(f"methods: expected different names separated by commas, found '{text}'")
    return found


def _value(text: str) -> Any:
    if text.lower() in ("true", "false"):
        # As recipes spell it. The text 'false' would count as true.
        return text.lower() == "true"
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text
