"""The methods of a benchmark: chosen by name, and constructed as denoisers whose stages are timed."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.methods import Spelling, parse_method, split_methods
from mcdenoise.models import Skipping, list_models
from mcdenoise.models._precision import PRECISIONS, has_network
from mcdenoise.models._times import Times
from mcdenoise.models._weights import pretrained_models
from mcdenoise.models._wrapper import parts_of
from mcdenoise.nn import FusionModule, UNet
from mcdenoise.results import KEEP_ALL, Kind, Method

BASELINES = ("noisy", "accumulated")
PRETRAINED, ALL = "pretrained", "all"
# The default choice: filters with a narrow and a wide setting, other denoisers, and all models with shipped weights.
COMPARED = (
    "joint_bilateral(sigma_color=0.1, sigma_space=1.5),joint_bilateral(sigma_color=0.2, sigma_space=4.0),svgf,"
    f"oidn(quality=fast|balanced|high, auxiliary=clean, source=raw|accumulated),{PRETRAINED}"
)


class Timed:
    """A denoiser whose run time is measured by stage.

    The stages are ``accumulate`` (all work before the model itself: validation, demodulation, accumulation, planning),
    ``network`` (U-Nets and convolutions anywhere in the model) and ``filter`` (all the rest: kernels, fusion,
    remodulation, and methods that report no stages). Hooks on the modules read a clock to separate ``network`` from
    ``filter``.

    Args:
        denoiser: any denoiser.

    Attributes:
        stages: milliseconds of each stage of the last call, by name in :data:`mcdenoise.results.STAGES`.
    """

    def __init__(self, denoiser: Denoiser) -> None:
        self.denoiser = denoiser
        self.stages: dict[str, float] = {}
        self._networks = [(module, "network") for module in _networks(denoiser.model)]

    def __call__(self, frame: Frame) -> Tensor:
        """Denoise the next frame of a shot."""
        times = Times(self.denoiser.device)
        with times.of("filter"), times.of_modules(self._networks):
            image = self.denoiser(frame)
        told, found = self.denoiser.report.milliseconds, times.milliseconds()
        before = sum(told.get(stage, 0.0) for stage in ("validate", "accumulate", "plan"))
        # A method without modules tells how long its network took; that of others is taken from outside.
        inside = {} if self._networks or "network" not in told else {"network": told["network"]}
        # On a GPU the times come from different clocks, so the difference may be slightly negative.
        rest = max(found["filter"] - before - sum(inside.values()), 0.0)
        self.stages = {"accumulate": before, **found, **inside, "filter": rest}
        return image


def make_method(method: Method, *, threads: int | None = None, device: str = "cpu") -> Timed:
    """Construct a method.

    Args:
        method: a method of :func:`choose_methods`.
        threads: number of threads for models that have a setting ``threads`` because they do not use torch's.
        device: ``"cpu"`` or ``"cuda"``.

    Raises:
        InputError: see :class:`mcdenoise.denoiser.Denoiser`.
    """
    spelling = Spelling(method.model, Path(method.weights) if method.weights else None, method.settings)
    more = {"threads": threads} if threads is not None and spelling.takes("threads") else {}
    return Timed(spelling.denoiser(precision=method.precision, device=device, keep_all=method.keep_all, **more))


def choose_methods(
    names: str | None = None,
    *,
    precisions: str = ",".join(PRECISIONS),
    keep_all: bool = False,
    baselines: Collection[str] = BASELINES,
) -> list[Method]:
    """The baselines and the named methods.

    Args:
        names: methods separated by commas, see :func:`mcdenoise.methods.split_methods`; ``"pretrained"`` means all
            models with shipped weights, ``None`` means :data:`COMPARED`, ``"all"`` means these and every other
            registered model, and ``"none"`` means none.
        precisions: precisions of the convolutions of trainable models, separated by commas: ``float32``, ``bfloat16``.
        keep_all: add a second variant of each method that skips work, which skips nothing.
        baselines: methods that are always included, first in the list.

    Returns:
        The methods. Methods whose package is not installed are marked as missing; so are methods without weights
        unless they were named.

    Raises:
        InputError: a method or precision is unknown, two methods have one name, or a model has no weights.
    """
    chosen = [each.strip() for each in precisions.split(",")]
    for name in chosen:
        if name not in PRECISIONS:
            raise InputError(f"--precisions: expected some of {', '.join(PRECISIONS)}, found '{name}'")
    named = names not in (None, ALL)
    text = COMPARED if names is None else _everything() if names == ALL else names
    methods: list[Method] = []
    seen: dict[str, Spelling] = {}
    for spelt in [*baselines, *(split_methods(text) if text != "none" else ())]:
        for one in pretrained_models() if spelt == PRETRAINED else [spelt]:
            spelling = parse_method(one)
            if (before := seen.setdefault(spelling.name, spelling)) is not spelling:
                if before != spelling:
                    raise InputError(
                        f"--models: expected a name for each method, found '{spelling.name}' for "
                        f"{before.weights or before.model} and {spelling.weights or spelling.model}; rename a file"
                    )
                continue
            kind: Kind = "baseline" if one in BASELINES else "fixed"
            method = Method(spelling.name, kind, "", spelling.model, spelling.settings, str(spelling.weights or ""))
            try:
                model = spelling.denoiser().model
            except InputError as error:
                if named and one not in BASELINES and not isinstance(error.__cause__, ImportError):
                    raise
                # Without the model's name, methods with the same reason can be listed in one line.
                methods.append(replace(method, missing=str(error).removeprefix(f"model '{one}': ")))
                continue
            methods += _variants(method, model, chosen, keep_all)
    return _with_folders(methods)


def _everything() -> str:
    """The default choice and the names of all other models."""
    known = {parse_method(each).model for each in split_methods(COMPARED) if each != PRETRAINED}
    known |= {*pretrained_models(), *BASELINES}
    return ",".join([COMPARED, *(name for name in list_models() if name not in known)])


def _variants(method: Method, model: Any, precisions: list[str], keep_all: bool) -> Iterator[Method]:
    """A model in each of the precisions that it has, and also without skipping if it skips work and this is wanted."""
    if not has_network(model):
        yield method
        return
    weights = sum(parameter.numel() for parameter in model.parameters()) if isinstance(model, nn.Module) else None
    whole = (False, True) if keep_all and next(parts_of(model, Skipping), None) else (False,)
    for precision in (each for each in PRECISIONS if each in precisions):
        for everything in whole:
            name = method.name if precision == "float32" else f"{method.name}, {precision}"
            name += KEEP_ALL if everything else ""
            yield replace(
                method, name=name, kind="trainable", precision=precision, keep_all=everything, parameters=weights
            )


def _with_folders(methods: list[Method]) -> list[Method]:
    """Give each method a folder of its own; folders whose names would be equal are numbered."""
    taken = {"reference"}
    unique = []
    for method in methods:
        first = folder = re.sub(r"[^a-z0-9._]+", "-", method.name.lower()).strip("-.") or "method"
        number = 2
        while folder in taken:
            folder, number = f"{first}-{number}", number + 1
        taken.add(folder)
        unique.append(replace(method, folder=folder))
    return unique


def _networks(model: Any) -> Iterator[nn.Module]:
    """The outermost U-Nets and convolutions of a model; the fusion of scales counts as filter."""
    if isinstance(model, UNet | nn.Sequential | nn.Conv2d | nn.ConvTranspose2d):
        yield model
    elif isinstance(model, nn.Module) and not isinstance(model, FusionModule):
        for child in model.children():
            yield from _networks(child)
