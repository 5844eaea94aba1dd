"""The front of a model: its outer wrappers, of which nothing is trained, which are computed once and cached."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from torch import nn

from mcdenoise.frame import RADIANCE, Frame
from mcdenoise.models import Accumulated, Demodulated, Model, Needs, Output, Restored, Skipping, State, Wrapper
from mcdenoise.models.demodulated import remodulated
from mcdenoise.models.filtered import FILTERED, Filtered
from mcdenoise.models.with_oidn import CENTRED, NOISY, OIDN, OIDN_ALBEDO, OIDN_CLEAN, WithOidn

# Buffers that accumulation and Open Image Denoise provide, with their channels.
ACCUMULATED: Mapping[str, int] = {"color": 3, "current": 3, "recent": 3, "length": 1}
_PARTS = frozenset(RADIANCE) - ACCUMULATED.keys()
GIVEN: Mapping[str, int] = {OIDN: 3, OIDN_CLEAN: 3, OIDN_ALBEDO: 3, NOISY: 3, CENTRED: 1}


@dataclass(frozen=True)
class Front:
    """The wrappers around a model that are not trained, up to the last one that provides images; may be empty.

    Args:
        wrappers: outermost first, each with the settings of its constructor.
        given: parts of the light, and features that a wrapper filters, that every frame has; they are cached as
            processed by the wrappers.
    """

    wrappers: tuple[tuple[type[Wrapper], dict[str, Any]], ...] = ()
    given: tuple[str, ...] = ()

    @property
    def accumulates(self) -> bool:
        """Whether the processed frames have a history: ``current`` and ``length``."""
        return self._has(Accumulated)

    @property
    def demodulates(self) -> bool:
        """Whether the radiance of the processed frames is demodulated."""
        return self._has(Demodulated)

    @property
    def parts(self) -> dict[str, int]:
        """Names and channels of the buffers that depend on the noise seed: radiance, and histories."""
        accumulated = ACCUMULATED if self.accumulates else {"color": 3}
        return {**accumulated, **dict.fromkeys(self.given, 3), **(GIVEN if self._has(WithOidn) else {})}

    def of(self, buffers: Collection[str]) -> Front:
        """The same front for frames that all have these buffers."""
        filtered = FILTERED if self._has(Filtered) else ()
        return replace(self, given=tuple(sorted(_PARTS.union(filtered) & set(buffers))))

    @property
    def settings(self) -> list[Any]:
        """Everything that the processed frames depend on, in JSON types."""
        wrappers = [[kind.__name__, settings] for kind, settings in self.wrappers]
        return [*wrappers, ["given", {"given": list(self.given)}]] if self.given else wrappers

    def _has(self, wanted: type[Wrapper]) -> bool:
        return any(kind is wanted for kind, _ in self.wrappers)

    def begin(self) -> Callable[[Frame], Frame]:
        """Return a function that processes the frames of one shot, in order, as input of the rest of the model."""
        seen = _Seen()
        model: Model = seen
        for kind, settings in reversed(self.wrappers):
            model = kind(model, **settings)
        state: State = None

        def step(frame: Frame) -> Frame:
            nonlocal state
            _, state = model(frame, state)
            return seen.frame

        return step


class _Seen(nn.Module):
    """Stores the frame that it receives."""

    needs = Needs(trainable=False)
    frame: Frame

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        self.frame = frame
        return Output(frame.color), None


class Remodulated(Wrapper):
    """Multiplies all images of a method by the albedo, for frames whose radiance is demodulated."""

    @property
    def needs(self) -> Needs:
        """The needs of the inner method, and the albedo."""
        return replace(self.inner.needs, buffers=self.inner.needs.buffers | {"albedo"})

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        output, state = self.inner(frame, state)
        return output if frame.albedo is None else output.lit(partial(remodulated, frame.albedo)), state


def split(model: Model) -> tuple[Front, Model]:
    """Split a model into its front, which is cached, and the rest, which is trained on the cached frames.

    Wrappers that only skip work are dropped, because training does not skip anything; so are the one that gives back
    what the rest smooths, because the rest should learn not to.
    """
    while type(model) is Restored:
        model = model.inner
    wrappers: list[tuple[type[Wrapper], dict[str, Any]]] = []
    found, rest = 0, model
    # Exact types only, because derived classes may do anything.
    while isinstance(model, Wrapper) and type(model) in (Filtered, Demodulated, Accumulated, WithOidn):
        # A wrapper stores the arguments of its constructor under the same names.
        _, *names = inspect.signature(type(model)).parameters
        wrappers.append((type(model), {name: getattr(model, name) for name in names}))
        model = model.inner
        if wrappers[-1][0] is not Demodulated:
            found, rest = len(wrappers), model
    front = Front(tuple(wrappers[:found]))
    while type(rest) is Skipping:
        rest = rest.inner
    return front, Remodulated(rest) if front.demodulates else rest
