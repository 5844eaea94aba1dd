"""Summaries of results over methods, settings and scenes: means, best settings, and comparisons of two models."""

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
        values: mean by metric, see :data:`mcdenoise.evaluate.METRICS`, without the metrics that cannot be computed.
        family: the model, if the results have it with several settings; otherwise empty.
        settings: settings of the model.
        chosen: for the best of several settings, the method with the best value, by metric.
    """

    scene: str
    method: str
    frames: int
    values: dict[str, float]
    family: str = ""
    settings: dict[str, Any] = field(default_factory=dict)
    chosen: dict[str, str] = field(default_factory=dict)


def scores_of(results: Results) -> list[Score]:
    """Scores of every method and setting, scene by scene; intermediate images precede their result.

    A method has no score for a scene on which it failed, and none at all if it is missing.
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
    """Mean over the scenes, in which every scene has the same weight, however many frames it has.

    Returns:
        One score for each method, for the scene ``mean of N``; metrics that a scene lacks are skipped.
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
    """Combine the settings of each model into one row per value of the settings ``by``, and one over all settings.

    The last row is named ``MODEL, best of N settings``. Each of its metrics is that of the setting with the best value,
    chosen by means of the reference, so the row flatters the model.

    Args:
        scores: of :func:`scores_of`.
        by: settings whose values get rows of their own, such as ``("quality", "source")``.

    Returns:
        Scores of each scene in order, with ``chosen`` in rows that combine several settings.
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
