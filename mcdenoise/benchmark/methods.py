"""What takes part in a benchmark: models, peers and baselines, each called with a frame and timed stage by stage."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol

import torch
from torch import Tensor, nn

from mcdenoise.benchmark.machine import Moment, Stopwatch
from mcdenoise.frame import Frame
from mcdenoise.denoiser import PRECISIONS, Denoiser, Images, Precision
from mcdenoise.errors import InputError
from mcdenoise.history import History
from mcdenoise.models import FusionModule, UNet, create_model, describe_weights, pretrained_models
from mcdenoise.ops import remodulate
from mcdenoise.peers import QUALITIES, JointBilateral, Oidn, OidnPeer, Peer, Quality
from mcdenoise.plan import Plan, Stage
from mcdenoise.results import KEEP_ALL, Kind, Method

PEERS = ("oidn", "bilateral")

# Of the plain filter: a narrow and a wide one.
_BILATERAL_SETTINGS = ((0.1, 1.5), (0.2, 4.0))


class Runner(Protocol):
    """A method at work on the frames of a shot.

    Args:
        stages: milliseconds of each stage of the last call, by name in :data:`mcdenoise.results.STAGES`.
    """

    stages: dict[str, float]

    def reset(self) -> None:
        """Forget the past: the next frame is the first of a shot."""
        ...

    def __call__(self, frame: Frame) -> Tensor:
        """Denoise the next frame.

        Args:
            frame: valid values (:meth:`mcdenoise.frame.Frame.validate`), on the device.

        Returns:
            ``(1, 3, H, W)`` float32 scene-linear radiance with albedo, on the device.
        """
        ...


@dataclass(frozen=True)
class Candidate:
    """A method that could take part.

    Args:
        method: what it is, and why it is missing where it is.
        make: makes it ready; its first call may still warm up. To have its memory measured, other processes must be
            able to call it too: a function of a module, or :func:`functools.partial` of one.
    """

    method: Method
    make: Callable[[], Runner]


class ModelRunner:
    """A model with everything :class:`mcdenoise.denoiser.Denoiser` does around it.

    Its stages are ``accumulate`` (also looking at every value, and planning), ``network`` (U-Nets and convolutions) and
    ``filter`` (all the rest: kernel weights, kernel convolution, fusion, remodulation). The second is told from the
    third by hooks on the modules, which read a clock.

    Args:
        model: see :class:`mcdenoise.denoiser.Denoiser`.
        weights: of a model given by name.
        precision: of the convolutions.
        device: where to run.
        keep_all: leave nothing out that a scene does not need.
    """

    def __init__(
        self,
        model: str | nn.Module,
        weights: Path | None = None,
        precision: Precision = "float32",
        device: str = "cpu",
        keep_all: bool = False,
    ) -> None:
        self.stages: dict[str, float] = {}
        plan = Plan(keep_all=keep_all)
        self._denoiser = Denoiser(model, weights=weights, precision=precision, device=device, plan=plan)
        self._watch = Stopwatch(device)
        self._marks: list[Moment] = []
        self._networks = list(_networks(self._denoiser.model))
        for module in self._networks:
            module.register_forward_pre_hook(self._mark)
            module.register_forward_hook(self._mark)

    @property
    def planned(self) -> list[Stage]:
        """What was left out of the last frame."""
        return self._denoiser.report.stages

    def reset(self) -> None:
        """See :class:`Runner`."""
        self._denoiser.reset()

    def __call__(self, frame: Frame) -> Tensor:
        """See :class:`Runner`."""
        self._marks.clear()
        image = self._denoiser(frame)
        times = self._denoiser.report.milliseconds
        pairs = zip(self._marks[::2], self._marks[1::2], strict=True)
        network = sum(self._watch.between(start, end) for start, end in pairs) if self._networks else times["network"]
        self.stages = {
            "accumulate": times["validate"] + times["plan"] + times["accumulate"],
            "network": network,
            # On a GPU the two are told by different clocks.
            "filter": max(times["network"] - network, 0.0) + times["remodulate"],
        }
        return image

    def _mark(self, *_: Any) -> None:
        self._marks.append(self._watch.mark())


class PeerRunner:
    """A peer, or nothing, on the image it starts from.

    What starts from the accumulated image pays for it: stage ``accumulate``, the same that a model pays for. What
    starts from the noisy one has no such stage.

    Args:
        peer: without one, the image to start from is the result.
        accumulates: start from the accumulated image, else from the noisy one.
        stage: what the peer's own work counts as.
        device: where to run, as far as the peer can choose.
    """

    def __init__(
        self,
        peer: Peer | None = None,
        accumulates: bool = False,
        stage: Literal["network", "filter"] = "filter",
        device: str = "cpu",
    ) -> None:
        self.stages: dict[str, float] = {}
        self._peer, self._accumulates, self._stage = peer, accumulates, stage
        self._history = History()
        self._watch = Stopwatch(device)

    def reset(self) -> None:
        """See :class:`Runner`."""
        self._history.reset()
        if self._peer is not None:
            self._peer.reset()

    @torch.inference_mode()
    def __call__(self, frame: Frame) -> Tensor:
        """See :class:`Runner`."""
        self.stages = {}
        image = frame.color
        start = self._watch.mark()
        if self._accumulates:
            frame, _ = frame.validate()
            frame = frame.with_depth()
            image = self._history.update(frame).color
            if frame.albedo is not None:
                image = remodulate(image, frame.albedo)
            self.stages["accumulate"] = self._watch.between(start, self._watch.mark())
        if self._peer is None:
            return image
        start = self._watch.mark()
        result = self._peer(frame, Images(frame.color, image, image, image))
        self.stages[self._stage] = self._watch.between(start, self._watch.mark())
        return result


def choose_candidates(
    models: str | None = None,
    peers: str = "all",
    *,
    precisions: str = ",".join(PRECISIONS),
    threads: int = 1,
    device: str = "cpu",
    keep_all: bool = False,
) -> list[Candidate]:
    """The baselines, and the chosen peers and models.

    Args:
        models: names of models with shipped weights, or weights files (``*.safetensors``), separated by commas;
            ``"none"``, or by default all with shipped weights.
        peers: names in :data:`PEERS`, separated by commas; ``"all"`` or ``"none"``. One whose package is not installed
            is there as missing.
        precisions: of the models' convolutions, separated by commas: ``float32``, ``bfloat16``.
        threads: of the peers that do not ask torch.
        device: where to run, ``"cpu"`` or ``"cuda"``; Open Image Denoise runs on the CPU.
        keep_all: have each model twice, the second time leaving nothing out that a scene does not need.

    Raises:
        InputError: a model, peer or precision is unknown, or a model has no weights.
    """
    wanted = _names(peers, "--peers", PEERS)
    kinds = [precision for precision in PRECISIONS if precision in _names(precisions, "--precisions", PRECISIONS)]
    candidates = [
        _candidate("noisy", "baseline", "baseline", functools.partial(PeerRunner, device=device)),
        _candidate("accumulated", "baseline", "baseline", functools.partial(PeerRunner, None, True, device=device)),
    ]
    if "bilateral" in wanted:
        candidates += [_bilateral_candidate(color, space, device) for color, space in _BILATERAL_SETTINGS]
    if "oidn" in wanted:
        candidates += _oidn_candidates(threads, device)
    for model in pretrained_models() if models is None else _list(models, "--models"):
        candidates += _model_candidates(model, kinds, device, keep_all)
    return _with_folders(candidates)


def one_line(error: BaseException) -> str:
    """What went wrong, for a table."""
    text = " ".join(str(error).split()) or "no reason given"
    return text if isinstance(error, InputError) else f"{type(error).__name__}: {text}"


def _names(text: str, option: str, known: Sequence[str]) -> Sequence[str]:
    if text == "all":
        return known
    names = _list(text, option)
    for name in names:
        if name not in known:
            raise InputError(f"{option}: expected some of {', '.join(known)}, or all, or none, found '{name}'")
    return names


def _list(text: str, option: str) -> list[str]:
    if text == "none":
        return []
    names = [name.strip() for name in text.split(",")]
    if "" in names or len(set(names)) < len(names):
        raise InputError(f"{option}: expected different names separated by commas, or none, found '{text}'")
    return names


def _candidate(name: str, kind: Kind, family: str, make: Callable[[], Runner], **about: Any) -> Candidate:
    return Candidate(Method(name, kind, _folder(name), family, **about), make)


def _folder(name: str) -> str:
    return re.sub(r"[^a-z0-9._]+", "-", name.lower()).strip("-.") or "method"


def _with_folders(candidates: list[Candidate]) -> list[Candidate]:
    """Each with a folder of its own; names that differ in their marks only are numbered."""
    taken = {"reference"}
    unique = []
    for candidate in candidates:
        first = folder = candidate.method.folder
        number = 2
        while folder in taken:
            folder, number = f"{first}-{number}", number + 1
        taken.add(folder)
        unique.append(replace(candidate, method=replace(candidate.method, folder=folder)))
    return unique


def _model_candidates(model: str, precisions: list[Precision], device: str, keep_all: bool) -> Iterator[Candidate]:
    path = Path(model) if model.endswith(".safetensors") else None
    name = model if path is None else path.stem
    architecture = model if path is None else str(describe_weights(path)["architecture"])
    made = create_model(architecture, pretrained=path is None, weights=path)
    parameters = sum(parameter.numel() for parameter in made.parameters())
    for precision in precisions:
        for everything in (False, True) if keep_all else (False,):
            full_name = name if precision == "float32" else f"{name}, {precision}"
            yield _candidate(
                full_name + KEEP_ALL if everything else full_name,
                "model",
                name,
                functools.partial(ModelRunner, architecture, path, precision, device, everything),
                parameters=parameters,
            )


def _bilateral_candidate(color: float, space: float, device: str) -> Candidate:
    peer = JointBilateral(color, space)
    return _candidate(peer.name, "peer", peer.family, functools.partial(PeerRunner, peer, True, "filter", device))


def _oidn_candidates(threads: int, device: str) -> list[Candidate]:
    try:
        _oidn(threads)
        missing = ""
    except InputError as error:
        missing = str(error)
    settings: list[tuple[Quality, Literal["raw", "accumulated"]]] = [
        (quality, source) for source in ("raw", "accumulated") for quality in QUALITIES
    ]
    return [
        _candidate(
            f"OIDN {quality}, clean aux, {source}",
            "peer",
            "OIDN",
            functools.partial(_oidn_runner, quality, source, threads, device),
            missing=missing,
        )
        for quality, source in settings
    ]


def _oidn_runner(quality: Quality, source: Literal["raw", "accumulated"], threads: int, device: str) -> Runner:
    peer = OidnPeer(_oidn(threads), quality, "clean", source)
    return PeerRunner(peer, source == "accumulated", "network", device)


@functools.cache
def _oidn(threads: int) -> Oidn:
    """One for all settings: they share its buffers."""
    return Oidn(threads=threads)


def _networks(model: nn.Module) -> Iterator[nn.Module]:
    """The U-Nets and convolutions of a model, outermost only; the fusion of scales is part of the filter."""
    for child in model.children():
        if isinstance(child, UNet | nn.Sequential | nn.Conv2d | nn.ConvTranspose2d):
            yield child
        elif not isinstance(child, FusionModule):
            yield from _networks(child)
