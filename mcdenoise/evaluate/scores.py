"""Errors of every way to denoise a sequence, against its references."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.data import Sequence
from mcdenoise.denoise import denoised_frames
from mcdenoise.denoiser import Denoiser, Images
from mcdenoise.errors import InputError
from mcdenoise.metrics import (
    Metric,
    UncomputableError,
    flip_srgb,
    psnr_srgb,
    relmse_linear,
    rmse_linear,
    smape_linear,
    ssim_srgb,
    temporal_rmse_srgb,
    temporal_smape_linear,
)
from mcdenoise.peers import Peer

METRICS: dict[str, Metric] = {
    "SMAPE": Metric(smape_linear),
    "relMSE": Metric(relmse_linear),
    "RMSE": Metric(rmse_linear),
    "PSNR": Metric(psnr_srgb, higher_is_better=True),
    "SSIM": Metric(ssim_srgb, higher_is_better=True),
    "FLIP": Metric(flip_srgb),
    "tSMAPE": Metric(temporal_smape_linear, temporal=True),
    "tRMSE": Metric(temporal_rmse_srgb, temporal=True),
}


@dataclass(frozen=True)
class Score:
    """Mean errors of one method on one sequence.

    Args:
        sequence: name of the sequence.
        method: what made the images.
        frames: number of frames with a reference.
        values: mean by metric: ``SMAPE``, ``relMSE`` and ``RMSE`` (scene-linear, lower is better), ``PSNR`` and
            ``SSIM`` (as displayed, higher is better), ``FLIP`` (as displayed, lower is better), ``tSMAPE``
            (scene-linear) and ``tRMSE`` (as displayed) of the change from frame to frame, lower is better. What could
            not be computed, such as a temporal error of one frame, is not in it.
        counts: number of frames, or pairs of frames, in each mean.
        group: of a setting of a peer, the settings that share a row with it.
        family: of a setting of a peer, the peer.
        chosen: of the best of several settings, which one it is, by metric.
        left_out: why a metric could not be computed, such as images smaller than its window.
    """

    sequence: str
    method: str
    frames: int
    values: dict[str, float]
    counts: dict[str, int] = field(default_factory=dict)
    group: str = ""
    family: str = ""
    chosen: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)


def measure(
    metrics: Mapping[str, Metric],
    image: Tensor,
    reference: Tensor,
    past: tuple[Tensor, Tensor] | None = None,
    left_out: dict[str, str] | None = None,
) -> dict[str, float]:
    """Every metric of one frame that can be computed.

    Args:
        metrics: by name.
        image: ``(1, 3, H, W)`` scene-linear radiance.
        reference: of the same shape.
        past: image and reference of the frame before; without them there are no temporal metrics.
        left_out: gets the reason for each metric that these images, or this installation, do not allow.
    """
    values = {}
    for name, metric in metrics.items():
        try:
            if not metric.temporal:
                values[name] = float(metric.function(image, reference))
            elif past is not None:
                clip, truth = torch.stack([past[0], image], 1), torch.stack([past[1], reference], 1)
                values[name] = float(metric.function(clip, truth))
        except UncomputableError as error:
            if left_out is not None:
                left_out[name] = str(error)
    return values


@dataclass(frozen=True)
class _Method:
    name: str
    group: str = ""
    family: str = ""


class Scorer:
    """Means of the metrics over the frames of a sequence, for any number of methods; keeps only the previous frame.

    Args:
        name: of the sequence.
        metrics: names in :data:`METRICS`.
        flip_every: FLIP is slow; compute it for the first of so many frames with a reference.
    """

    def __init__(
        self, name: str, *, metrics: Collection[str] = ("SMAPE", "relMSE", "PSNR"), flip_every: int = 1
    ) -> None:
        self.name, self.metrics, self.flip_every = name, metrics, flip_every
        self._values: dict[_Method, dict[str, list[float]]] = {}
        self._past: dict[_Method, Tensor] = {}
        self._past_reference: Tensor | None = None
        self._frames = 0
        self._left_out: dict[str, str] = {}

    def add(self, frame: Frame, images: Images) -> None:
        """Score the noisy, accumulated, initial and denoised image of the next frame; without a reference, none."""
        names = ("noisy", "accumulated", "initial", "denoised")
        self._add(frame.reference, ((_Method(name), getattr(images, name)) for name in names))

    @torch.inference_mode()
    def _add(self, reference: Tensor | None, images: Iterable[tuple[_Method, Tensor]], *, follows: bool = True) -> None:
        """Score the images of the next frame; ``follows`` says whether it is the successor of the one before.

        All images are asked for, also where there is no reference to compare them with.
        """
        past, past_reference = self._past, self._past_reference if follows else None
        self._past, self._past_reference = {}, reference
        rare = self._frames % self.flip_every != 0
        metrics = {name: METRICS[name] for name in self.metrics if not (rare and name == "FLIP")}
        for method, image in images:
            # Each image of the past is let go as soon as its successor is there.
            before = past.pop(method, None)
            if reference is None:
                continue
            device = image.device
            pair = None if before is None or past_reference is None else (before, past_reference.to(device))
            values = self._values.setdefault(method, {})
            for name, value in measure(metrics, image, reference.to(device), pair, self._left_out).items():
                values.setdefault(name, []).append(value)
            self._past[method] = image
        self._frames += reference is not None

    def scores(self) -> list[Score]:
        """The means so far, in the order in which the methods came."""
        return [
            Score(
                self.name,
                method.name,
                self._frames,
                {name: sum(own) / len(own) for name, own in values.items()},
                {name: len(own) for name, own in values.items()},
                method.group,
                method.family,
                left_out=dict(self._left_out),
            )
            for method, values in self._values.items()
        ]


def check_references(sequence: Sequence) -> None:
    """See that there is something to compare with.

    Raises:
        InputError: the sequence has no references.
    """
    if not sequence.reference_numbers:
        raise InputError(f"{sequence.root}: expected references to compare with, found none; render them")


def score_sequence(
    sequence: Sequence,
    denoisers: Mapping[str, Denoiser],
    *,
    peers: Iterable[Peer] = (),
    metrics: Collection[str] = tuple(METRICS),
    flip_every: int = 1,
    on_frame: Callable[[int], None] = lambda number: None,
) -> list[Score]:
    """Denoise a sequence in every way, in one pass, and score the results.

    Methods are ``noisy``, ``accumulated`` (by the first denoiser), every peer by its name, and for every model
    ``NAME, initial`` (result of its first network) and ``NAME``. Frames without a reference are denoised, as a history
    needs them, and not scored; a temporal error takes pairs of frames with successive numbers and references.

    Args:
        sequence: frames with references.
        denoisers: by the name of the model; are reset first.
        peers: see :mod:`mcdenoise.peers`; are reset first.
        metrics: names in :data:`METRICS`.
        flip_every: see :class:`Scorer`.
        on_frame: called with the number of each frame that is done.

    Returns:
        A score of every method and setting; see :func:`mcdenoise.evaluate.folded` for fewer. A metric that cannot be
        computed, because a package is missing or the images are too small, is left out, with the reason.

    Raises:
        InputError: the sequence has no references, or a buffer has invalid values.
        ValueError: no denoiser is given.
    """
    check_references(sequence)
    if not denoisers:
        raise ValueError("denoisers: expected one at least, found none")
    peers = list(peers)
    scorer = Scorer(sequence.name, metrics=metrics, flip_every=flip_every)
    first, *others = denoisers.values()
    for other in others:
        other.reset()
    for peer in peers:
        peer.reset()
    before: int | None = None
    for number, (frame, images) in zip(sequence.numbers, denoised_frames(sequence, first), strict=True):
        known = [images, *(other.images(frame) for other in others)]
        methods = _images(frame, dict(zip(denoisers, known, strict=True)), peers)
        scorer._add(frame.reference, methods, follows=before is not None and number == before + 1)
        before = number
        on_frame(number)
    return scorer.scores()


def _images(frame: Frame, known: Mapping[str, Images], peers: Iterable[Peer]) -> Iterable[tuple[_Method, Tensor]]:
    """Every method and its image; a peer runs when its image is asked for.

    Without a reference only those peers run that remember, since they must see every frame.
    """
    first = next(iter(known.values()))
    yield _Method("noisy"), first.noisy
    yield _Method("accumulated"), first.accumulated
    frame, _ = frame.with_depth().validate()
    for peer in peers:
        if frame.reference is None and not peer.remembers:
            continue
        yield _Method(peer.name, peer.group, peer.family), peer(frame, first)
    for name, images in known.items():
        yield _Method(f"{name}, initial"), images.initial
        yield _Method(name), images.denoised
