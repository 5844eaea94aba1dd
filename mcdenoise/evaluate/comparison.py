"""Scores of many methods, settings and scenes in short: means, the best settings, and who is ahead."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

from mcdenoise.evaluate.scores import METRICS, Score


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
