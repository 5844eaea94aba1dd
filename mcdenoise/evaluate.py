"""Errors of every way to denoise a sequence, against its references, and who is ahead."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import groupby

import torch
from torch import Tensor

from mcdenoise.buffers import Frame
from mcdenoise.data import Sequence
from mcdenoise.denoise import denoised_frames
from mcdenoise.denoiser import Denoiser, Images
from mcdenoise.errors import InputError
from mcdenoise.metrics import (
    flip_srgb,
    psnr_srgb,
    relmse_linear,
    smape_linear,
    ssim_srgb,
    temporal_rmse_srgb,
    temporal_smape_linear,
)
from mcdenoise.peers import Peer


@dataclass(frozen=True)
class Metric:
    """How to compare an image with its reference.

    Args:
        function: of image and reference, ``(1, 3, H, W)``, or of two clips, ``(1, 2, 3, H, W)``.
        higher_is_better: whether it is a similarity; else it is an error.
        temporal: whether it takes pairs of successive frames.
    """

    function: Callable[[Tensor, Tensor], Tensor]
    higher_is_better: bool = False
    temporal: bool = False

    def better(self, value: float, other: float) -> bool:
        """Whether the first value is better than the other; equal ones are not."""
        return value > other if self.higher_is_better else value < other


METRICS: dict[str, Metric] = {
    "SMAPE": Metric(smape_linear),
    "relMSE": Metric(relmse_linear),
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
        values: mean by metric: ``SMAPE`` and ``relMSE`` (scene-linear, lower is better), ``PSNR`` and ``SSIM`` (as
            displayed, higher is better), ``FLIP`` (as displayed, lower is better), ``tSMAPE`` (scene-linear) and
            ``tRMSE`` (as displayed) of the change from frame to frame, lower is better. What could not be computed,
            such as a temporal error of one frame, is not in it.
        counts: number of frames, or pairs of frames, in each mean.
        group: of a setting of a peer, the settings that share a row with it.
        family: of a setting of a peer, the peer.
        chosen: of the best of several settings, which one it is, by metric.
    """

    sequence: str
    method: str
    frames: int
    values: dict[str, float]
    counts: dict[str, int] = field(default_factory=dict)
    group: str = ""
    family: str = ""
    chosen: dict[str, str] = field(default_factory=dict)


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

    def add(self, frame: Frame, images: Images) -> None:
        """Score the noisy, accumulated, initial and denoised image of the next frame; without a reference, none."""
        names = ("noisy", "accumulated", "initial", "denoised")
        self._add(frame.reference, ((_Method(name), getattr(images, name)) for name in names))

    @torch.inference_mode()
    def _add(self, reference: Tensor | None, images: Iterable[tuple[_Method, Tensor]], *, follows: bool = True) -> None:
        """Score the images of the next frame; ``follows`` says whether it is the successor of the one before."""
        if reference is None:
            self._past, self._past_reference = {}, None
            return
        past, past_reference = self._past, self._past_reference if follows else None
        self._past, self._past_reference = {}, reference
        left_out = set() if self._frames % self.flip_every == 0 else {"FLIP"}
        for method, image in images:
            expected = reference.to(image.device)
            values = self._values.setdefault(method, {})
            for name in self.metrics:
                metric = METRICS[name]
                if name in left_out or (metric.temporal and past_reference is None):
                    continue
                if metric.temporal and past_reference is not None:
                    clip = torch.stack([past[method], image], 1)
                    value = metric.function(clip, torch.stack([past_reference.to(image.device), expected], 1))
                else:
                    value = metric.function(image, expected)
                values.setdefault(name, []).append(float(value))
            self._past[method] = image
            # Each image of the past is let go as soon as its successor is there.
            past.pop(method, None)
        self._frames += 1

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
        A score of every method and setting; see :func:`folded` for fewer.

    Raises:
        InputError: the sequence has no references, a buffer has invalid values, or a package that a metric needs is
            not installed.
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
        if frame.reference is None:
            # Nothing to compare with, but what remembers must see every frame.
            valid, _ = frame.with_depth().validate()
            with torch.inference_mode():
                for peer in peers:
                    if peer.remembers:
                        peer(valid, images)
        methods = _images(frame, dict(zip(denoisers, known, strict=True)), peers)
        scorer._add(frame.reference, methods, follows=before is not None and number == before + 1)
        before = number
        on_frame(number)
    return scorer.scores()


def _images(frame: Frame, known: Mapping[str, Images], peers: Iterable[Peer]) -> Iterable[tuple[_Method, Tensor]]:
    """Every method and its image; a peer runs when its image is asked for."""
    first = next(iter(known.values()))
    yield _Method("noisy"), first.noisy
    yield _Method("accumulated"), first.accumulated
    frame, _ = frame.with_depth().validate()
    for peer in peers:
        yield _Method(peer.name, peer.group, peer.family), peer(frame, first)
    for name, images in known.items():
        yield _Method(f"{name}, initial"), images.initial
        yield _Method(name), images.denoised


def mean_over_scenes(scores: Iterable[Score]) -> list[Score]:
    """Every scene counts the same, however many frames it has.

    Returns:
        One score for each method, under the name ``mean of N``; a metric that one of its scenes lacks is left out.
    """
    by_method: dict[str, list[Score]] = {}
    for score in scores:
        by_method.setdefault(score.method, []).append(score)
    means = []
    for method, own in by_method.items():
        names = [name for name in own[0].values if all(name in score.values for score in own)]
        means.append(
            Score(
                f"mean of {len(own)}",
                method,
                sum(score.frames for score in own),
                {name: sum(score.values[name] for score in own) / len(own) for name in names},
                {name: sum(score.counts.get(name, 0) for score in own) for name in names},
                own[0].group,
                own[0].family,
            )
        )
    return means


def folded(scores: Iterable[Score]) -> list[Score]:
    """Fold the settings of every peer to a row for each group and one for all, ``PEER, best of N settings``.

    In such a row every metric is that of the setting which is best in it, by the reference: it flatters the peer.

    Args:
        scores: of :func:`score_sequence`, for any number of sequences one after the other.

    Returns:
        Scores of each sequence in their order, with ``chosen`` in the rows that stand for several settings.
    """
    rows = []
    for _, sequence in groupby(scores, lambda score: score.sequence):
        for family, own in groupby(sequence, lambda score: score.family):
            settings = list(own)
            if not family:
                rows += settings
                continue
            groups = list(dict.fromkeys(score.group for score in settings))
            if len(groups) > 1:
                rows += [_best([score for score in settings if score.group == group], group) for group in groups]
            rows.append(_best(settings, f"{family}, best of {len(settings)} settings"))
    return rows


def _best(settings: list[Score], method: str) -> Score:
    values, chosen = {}, {}
    for name in settings[0].values:
        best = settings[0]
        for score in settings[1:]:
            if METRICS[name].better(score.values[name], best.values[name]):
                best = score
        values[name], chosen[name] = best.values[name], best.method
    first = settings[0]
    return Score(
        first.sequence, method, first.frames, values, first.counts, family=first.family, group=method, chosen=chosen
    )


def summary(scores: Iterable[Score]) -> list[Score]:
    """The mean over the scenes, with each peer twice: in one setting for all scenes, and in the best for each.

    Args:
        scores: of :func:`score_sequence`, for several sequences.

    Returns:
        As :func:`folded` of :func:`mean_over_scenes`, where ``best of N settings`` is the best one for all scenes;
        after it, ``PEER, best of each scene``: the mean of the scenes' best, each with a setting of its own.
    """
    scores = list(scores)
    of_each = {row.family: row for row in _best_of_each_scene(scores)}
    rows = []
    for row in folded(mean_over_scenes(scores)):
        rows.append(row)
        if row.family and row.method.startswith(f"{row.family}, best of"):
            rows.append(of_each[row.family])
    return rows


def _best_of_each_scene(scores: Iterable[Score]) -> list[Score]:
    scores = [score for score in scores if score.family]
    return mean_over_scenes(
        _best(list(own), f"{family}, best of each scene")
        for (_, family), own in groupby(scores, lambda score: (score.sequence, score.family))
    )


@dataclass(frozen=True)
class Verdict:
    """A model against a peer in one metric.

    Args:
        metric: name in :data:`METRICS`.
        model: whose final image it is.
        family: the peer.
        value: mean over the scenes of the model.
        single: mean over the scenes of that setting of the peer which has the best mean.
        setting: its name.
        best: mean over the scenes of the peer's best setting for each scene.
        scenes: for each scene the model's value, and that of the peer's best setting for it.
    """

    metric: str
    model: str
    family: str
    value: float
    single: float
    setting: str
    best: float
    scenes: dict[str, tuple[float, float]]

    @property
    def ahead(self) -> bool:
        """Whether the model is better than the peer's best single setting."""
        return METRICS[self.metric].better(self.value, self.single)

    @property
    def won(self) -> list[str]:
        """Scenes in which the model is better than the peer's best setting for that scene."""
        better = METRICS[self.metric].better
        return [scene for scene, (value, other) in self.scenes.items() if better(value, other)]

    def __str__(self) -> str:
        """The verdict in one line; errors are compared by their ratio, similarities by their difference."""
        line = (
            f"{self.metric}: {self.model} {self.value:.4g}; {self.family}'s best single setting {self.single:.4g} "
            f"({self.setting}): {self._against(self.single)}; its best setting of each scene {self.best:.4g}: "
            f"{self._against(self.best)}; better in {len(self.won)} of {len(self.scenes)} scenes"
        )
        lost = [scene for scene in self.scenes if scene not in self.won]
        return line + (f", not in {', '.join(lost)}" if lost else "")

    def _against(self, other: float) -> str:
        if METRICS[self.metric].higher_is_better:
            return f"{self.value - other:+.4g}"
        return f"{self.value / other:.3f} times" if other else "no ratio to 0"


def verdicts(scores: Iterable[Score], model: str, family: str = "OIDN") -> list[Verdict]:
    """Compare a model's final images with a peer, metric by metric.

    Args:
        scores: of :func:`score_sequence`, for one or several sequences.
        model: name of one of the denoisers.
        family: the peer: ``"OIDN"`` or ``"joint bilateral"``.

    Raises:
        ValueError: the scores have no such model or peer.
    """
    scores = list(scores)
    ours = {score.sequence: score for score in scores if score.method == model}
    theirs = [score for score in scores if score.family == family]
    if not ours or not theirs:
        raise ValueError(f"scores: expected those of '{model}' and of '{family}', found one of them missing")
    (mean,) = mean_over_scenes(ours.values())
    single = _best(mean_over_scenes(theirs), family)
    (best,) = _best_of_each_scene(theirs)
    by_scene = {name: _best(list(own), family) for name, own in groupby(theirs, lambda score: score.sequence)}
    return [
        Verdict(
            metric,
            model,
            family,
            value,
            single.values[metric],
            single.chosen[metric],
            best.values[metric],
            {name: (score.values[metric], by_scene[name].values[metric]) for name, score in ours.items()},
        )
        for metric, value in mean.values.items()
    ]


def reference_noise(sequence: Sequence) -> float | None:
    """How noisy the references themselves are: the mean over the frames of what the renderer has noted.

    Returns:
        The mean of ``reference_noise`` in ``camera.json``, by frame number: the references' own SMAPE against the
        truth, as estimated by the renderer. ``None`` where nothing is noted.
    """
    for path in (sequence.root / "camera.json", sequence.root / "inputs" / "camera.json"):
        if path.is_file():
            noted = json.loads(path.read_text()).get("reference_noise")
            if isinstance(noted, dict):
                estimates = (noted.get(str(number)) for number in sequence.reference_numbers)
                own = [float(estimate) for estimate in estimates if estimate is not None]
                return sum(own) / len(own) if own else None
    return None
