"""Summaries of benchmarks of many methods, settings and scenes: means, best settings, and comparisons."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any

from mcdenoise.evaluate import METRICS
from mcdenoise.results import Results


@dataclass(frozen=True)
class Score:
    """Mean errors of one method on one scene.

    Args:
        scene: name of the scene.
        method: name of the method, with ``", STAGE"`` for an intermediate image.
        frames: number of frames with a reference.
        values: mean by metric, see :data:`mcdenoise.evaluate.METRICS`. Metrics that could not be computed are missing.
        family: name of the model, if the results contain it with several settings.
        settings: settings of the model.
        chosen: for the best of several settings, the chosen one by metric.
    """

    scene: str
    method: str
    frames: int
    values: dict[str, float]
    family: str = ""
    settings: dict[str, Any] = field(default_factory=dict)
    chosen: dict[str, str] = field(default_factory=dict)


def scores_of(results: Results) -> list[Score]:
    """One score for every method and setting on every scene, by scene; intermediate images precede their result.

    A method that is missing, or failed on a scene, has no score there.
    """
    counts = Counter(method.model for method in results.methods if method.settings)
    scores = []
    for scene in results.scenes:
        for method in results.methods:
            cell = results.cell(scene.name, method.name)
            if cell is None or cell.failure:
                continue
            several = bool(method.settings) and counts[method.model] > 1
            family, settings = (method.model, method.settings) if several else ("", {})
            for stage, values in cell.on_the_way.items() if not several else ():
                scores.append(Score(scene.name, f"{method.name}, {stage}", len(scene.scored), values))
            scores.append(Score(scene.name, method.name, len(scene.scored), cell.errors, family, settings))
    return scores


def mean_over_scenes(scores: Iterable[Score]) -> list[Score]:
    """Average over scenes, with equal weights whatever the numbers of frames.

    Returns:
        One score for each method, named ``mean of N``; a metric that one of its scenes lacks is omitted.
    """
    by_method: dict[str, list[Score]] = {}
    for score in scores:
        by_method.setdefault(score.method, []).append(score)
    means = []
    for own in by_method.values():
        names = [name for name in own[0].values if all(name in score.values for score in own)]
        values = {name: sum(score.values[name] for score in own) / len(own) for name in names}
        frames = sum(score.frames for score in own)
        means.append(replace(own[0], scene=f"mean of {len(own)}", frames=frames, values=values))
    return means


def folded(scores: Iterable[Score], by: Collection[str] = ()) -> list[Score]:
    """Combine the settings of every model in one row, ``MODEL, best of N settings``, or one row per value of ``by``.

    In such a row, every metric is that of the setting that is best in this metric by the reference, so it is
    optimistic.

    Args:
        scores: result of :func:`scores_of`.
        by: settings whose values have separate rows, such as ``("quality", "source")``.

    Returns:
        Scores of each scene in their order; rows that combine several settings have ``chosen``.
    """
    rows = []
    for _, scene in groupby(scores, lambda score: score.scene):
        for family, own in groupby(scene, lambda score: score.family):
            settings = list(own)
            if not family:
                rows += settings
                continue
            groups: dict[str, list[Score]] = {}
            for score in settings:
                kept = ", ".join(f"{name}={value}" for name, value in score.settings.items() if name in by)
                groups.setdefault(f"{family}({kept})" if kept else family, []).append(score)
            if len(groups) > 1:
                rows += [_best(group, name) for name, group in groups.items()]
            rows.append(_best(settings, f"{family}, best of {len(settings)} settings"))
    return rows


def _best(settings: list[Score], method: str) -> Score:
    values, chosen = {}, {}
    for name in settings[0].values:
        if not all(name in score.values for score in settings):
            continue
        best = settings[0]
        for score in settings[1:]:
            if METRICS[name].better(score.values[name], best.values[name]):
                best = score
        values[name], chosen[name] = best.values[name], best.method
    return replace(settings[0], method=method, values=values, settings={}, chosen=chosen)


def summary(scores: Iterable[Score], by: Collection[str] = ()) -> list[Score]:
    """Means over the scenes; a model of several settings has two rows, the best single setting and the best per scene.

    Args:
        scores: result of :func:`scores_of`, for several scenes.
        by: see :func:`folded`.

    Returns:
        The result of :func:`folded` for :func:`mean_over_scenes`, where ``best of N settings`` is the best single
        setting for all scenes; followed by ``MODEL, best of each scene``: the mean of the best values of the scenes.
    """
    scores = list(scores)
    of_each = {row.family: row for row in _best_of_each_scene(scores)}
    rows = []
    for row in folded(mean_over_scenes(scores), by):
        rows.append(row)
        if row.family and row.method.startswith(f"{row.family}, best of"):
            rows.append(of_each[row.family])
    return rows


def _best_of_each_scene(scores: Iterable[Score]) -> list[Score]:
    scores = [score for score in scores if score.family]
    return mean_over_scenes(
        _best(list(own), f"{family}, best of each scene")
        for (_, family), own in groupby(scores, lambda score: (score.scene, score.family))
    )


@dataclass(frozen=True)
class Verdict:
    """Comparison of a method with a model of several settings, in one metric.

    Args:
        metric: name in :data:`METRICS`.
        method: name of the method.
        family: name of the model of several settings.
        value: the method's mean over the scenes.
        single: the model's mean over the scenes with its best single setting.
        setting: name of that setting.
        best: the model's mean over the scenes with the best setting for each scene.
        scenes: for each scene, the method's value and that of the model's best setting for it.
    """

    metric: str
    method: str
    family: str
    value: float
    single: float
    setting: str
    best: float
    scenes: dict[str, tuple[float, float]]

    @property
    def ahead(self) -> bool:
        """Whether the method is better than the model's best single setting."""
        return METRICS[self.metric].better(self.value, self.single)

    @property
    def won(self) -> list[str]:
        """Scenes in which the method is better than the model's best setting for that scene."""
        better = METRICS[self.metric].better
        return [scene for scene, (value, other) in self.scenes.items() if better(value, other)]

    def __str__(self) -> str:
        """The verdict in one line; errors are compared by their ratio, similarities by their difference."""
        line = (
            f"{self.metric}: {self.method} {self.value:.4g}; {self.family}'s best single setting {self.single:.4g} "
            f"({self.setting}): {self._against(self.single)}; its best setting of each scene {self.best:.4g}: "
            f"{self._against(self.best)}; better in {len(self.won)} of {len(self.scenes)} scenes"
        )
        lost = [scene for scene in self.scenes if scene not in self.won]
        return line + (f", not in {', '.join(lost)}" if lost else "")

    def _against(self, other: float) -> str:
        if METRICS[self.metric].higher_is_better:
            return f"{self.value - other:+.4g}"
        return f"{self.value / other:.3f} times" if other else "no ratio to 0"


def verdicts(scores: Iterable[Score], method: str, family: str = "oidn") -> list[Verdict]:
    """Compare a method with a model of several settings in every metric.

    Args:
        scores: result of :func:`scores_of`.
        method: name of the method.
        family: name of the model.

    Raises:
        ValueError: the scores do not contain the method or the model.
    """
    scores = list(scores)
    ours = {score.scene: score for score in scores if score.method == method}
    theirs = [score for score in scores if score.family == family]
    if not ours or not theirs:
        raise ValueError(f"scores: expected those of '{method}' and of '{family}', found one of them missing")
    (mean,) = mean_over_scenes(ours.values())
    single = _best(mean_over_scenes(theirs), family)
    (best,) = _best_of_each_scene(theirs)
    by_scene = {name: _best(list(own), family) for name, own in groupby(theirs, lambda score: score.scene)}
    return [
        Verdict(
            metric,
            method,
            family,
            value,
            single.values[metric],
            single.chosen[metric],
            best.values[metric],
            {name: (score.values[metric], by_scene[name].values[metric]) for name, score in ours.items()},
        )
        for metric, value in mean.values.items()
        if metric in single.values
    ]
