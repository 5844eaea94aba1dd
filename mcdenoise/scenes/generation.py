"""What ``mcdenoise generate`` renders of each number: a sequence, by Mitsuba or by Cycles, or a take to train on.

A take is a short shot or a still of a random place, a packed file that its number determines.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.data.files import write_json, write_text
from mcdenoise.data.shards import ERROR, SUFFIX, find_shards, open_shard, write_shard
from mcdenoise.errors import InputError
from mcdenoise.reading import read_text
from mcdenoise.scenes.assets import Assets
from mcdenoise.scenes.cycles import Blender, render_cycles
from mcdenoise.scenes.render import render_sequence
from mcdenoise.scenes.takes.draw import FRAMES, REFERENCES, Take, draw_take
from mcdenoise.scenes.takes.tracing import HALF, TakeTracer

Frame: TypeAlias = dict[str, Array]
_ATTEMPTS = 6
# Largest SMAPE between two means of eight samples: with more, the references are noise, too.
_NOISIEST = 0.65
_MIDDLE = 0.2
_BLOCK = 8
# Width of the images by which it is decided what the place of a sequence shows, in pixels.
_PROBED = 32


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is rendered of each of many numbers: each is a task that any machine can do.

    Args:
        out: folder of the files; what is finished in it is kept.
        assets: what scenes are made of.
        unseen: whether only from the tenth of the assets that is never trained on.
        frames: of a clip.
        threads: of the renderer; 0 for all processors.
    """

    out: Path
    assets: Assets
    unseen: bool
    frames: int = FRAMES
    threads: int = 0

    def render(self, number: int, progress: Callable[[int, int], None] | None = None) -> Path:
        """Render what a number is, as far as it is not there yet.

        Args:
            number: 0 or more: of the place, and seed of the noise.
            progress: called with the finished and the total number of samples a pixel; not for a take.

        Returns:
            Its file or folder.

        Raises:
            InputError: Mitsuba or Blender is missing or fails, or the folder cannot be written or holds something else.
        """
        raise NotImplementedError

    def draw(self, number: int, attempt: int = 0, **settings: Any) -> Take:
        """A place for a number, see :func:`draw_take`."""
        return draw_take(number, self.assets.part(self.unseen), attempt, frames=self.frames, **settings)

    def first_worth(self, number: int, variant: str, half: int = HALF, **settings: Any) -> tuple[TakeTracer, Frame]:
        """The first draw that is worth its references, or the last one: its tracer, and its last noisy frame."""
        for attempt in range(_ATTEMPTS):
            take = self.draw(number, attempt, **settings)
            tracer, last = TakeTracer(take, variant, self.threads, half), len(take.cameras) - 1
            final = tracer.noisy(last)
            if _shows_enough(final, take.void) and tracer.noise(last) < _NOISIEST:
                break
        return tracer, final


@dataclass(frozen=True, kw_only=True)
class SequencePlan(Plan):
    """How sequences are rendered.

    Args:
        rendering: arguments of :func:`mcdenoise.scenes.render.render_sequence`, its variant among them.
        cycles: whether Cycles renders them, which has no use for workers and variant, else Mitsuba.
        parts: whether Cycles writes diffuse and specular light, too.
    """

    rendering: Mapping[str, Any]
    cycles: bool = False
    parts: bool = False

    def render(self, number: int, progress: Callable[[int, int], None] | None = None) -> Path:
        """Render the sequence of a number."""
        out, rendering = self.out / f"random{number:04d}", dict(self.rendering, seed=number, progress=progress)
        width, height = (max(side, 1) for side in rendering["size"])
        if self.cycles:
            # What a place shows is not decided, because that needs Mitsuba.
            take = self.draw(number, size=(width, height), stills=False)
            del rendering["workers"], rendering["variant"]
            with Blender() as blender:
                folder = render_cycles(take, out, blender, parts=self.parts, threads=self.threads, **rendering)
        else:
            # Clips that are sampled once at pixel centres, to see what they show.
            size = _PROBED, max(1, _PROBED * height // width)
            tracer, _ = self.first_worth(number, rendering["variant"], size=size, stills=False, plain=True)
            take = tracer.take
            tracer.release()
            folder = render_sequence(take.scene, take.cameras, out, moves=take.moves, **rendering)
        if take.credits:
            write_text(out / "credits.txt", "\n".join((*take.credits, "")))
        return folder


@dataclass(frozen=True, kw_only=True)
class TakePlan(Plan):
    """How takes are rendered.

    Args:
        variant: of Mitsuba.
        size: width and height in pixels; by default those of training.
        half: samples a pixel of each half of a reference.
        plain: whether takes are shots of one sample at pixel centres, with features without noise.
    """

    variant: str
    size: tuple[int, int] | None = None
    half: int = HALF
    plain: bool = False

    @property
    def identity(self) -> dict[str, Any]:
        """What all takes of a folder have in common."""
        own = {"takes": 1, "unseen": self.unseen, "assets": self.assets.digest, "frames": self.frames}
        own |= {"size": list(self.size) if self.size else None, "variant": self.variant}
        return own | ({"plain": True} if self.plain else {}) | {"reference_spp": 2 * self.half}

    def render(self, number: int, progress: Callable[[int, int], None] | None = None) -> Path:
        """Render the take of a number."""
        self._claim()
        path = self.out / f"{number:06d}{SUFFIX}"
        if not path.exists():
            self._render(number, path)
        return path

    def _claim(self) -> None:
        """Write what the folder holds, or compare it with what is there."""
        about, own = self.out / "takes.json", self.identity
        try:
            self.out.mkdir(parents=True, exist_ok=True)
            found = dict(json.loads(read_text(about)) if about.exists() else own)
        except (OSError, ValueError, TypeError) as error:
            raise InputError(f"{self.out}: expected a folder to write takes to, found {error}") from error
        if "variant" not in found:
            # Only the takes themselves tell it in an older folder.
            names = {str(open_shard(path).header.get("renderer")) for path in find_shards(self.out)}
            others = sorted(name for name in names if f"({self.variant}, " not in name)
            found["variant"] = ", ".join(others) or self.variant
        for key in sorted(found.keys() | own):
            if found.get(key) != own.get(key):
                differ = f"expected takes with {key} {own.get(key)}, found {found.get(key)}"
                raise InputError(f"{self.out}: {differ}; choose another folder")
        write_json(about, own)

    def _render(self, number: int, path: Path) -> None:
        tracer, final = self.first_worth(number, self.variant, self.half, size=self.size, plain=self.plain)
        take, last = tracer.take, len(tracer.take.cameras) - 1
        noisy, means, errors = [], [], []
        for frame in range(last + 1):
            noisy.append(final if frame == last else tracer.noisy(frame))
            if frame > last - REFERENCES:
                first, second = tracer.halves(frame)
                means.append((first + second) / 2)
                errors.append((first - second) / 2)
        arrays: dict[str, Any] = {
            name: np.stack([images[name] for images in noisy]).astype(np.float32) for name in final
        }
        # What was seen before the first frame is unknown.
        arrays["motion"][0] = np.inf
        level = _level(means[-1])
        light: dict[str, Any] = {"color": arrays["color"], "reference": np.stack(means), ERROR: np.stack(errors)}
        arrays |= {name: image * level for name, image in light.items()}
        header = {
            "number": number,
            **take.settings,
            "renderer": tracer.name,
            "exposure": level,
            "reference_spp": 2 * self.half,
            "assets": self.assets.digest,
            "unseen": self.unseen,
            "moving": sorted(take.moves),
            "credits": list(take.credits),
        }
        tracer.release()
        write_shard(path, header, arrays)


def _shows_enough(frame: Frame, void: bool) -> bool:
    """Whether a frame is worth its references: neither black, nor nearly empty, nor one plain surface close by."""
    hit = frame["alpha"][0] > 0.5
    if hit.mean() < (0.04 if void else 0.3):
        return False
    depth = np.where(np.isfinite(frame["depth"][0]), frame["depth"][0], 1e3)
    if float((depth < 0.12).mean()) > 0.3:
        return False
    light = _blocks(frame["color"]).mean(0)[_blocks(frame["alpha"])[0] > 0.5]
    if light.size == 0 or not float(np.median(light)) > 0.02 * float(light.mean()) > 0:
        return False
    looks = np.concatenate([_blocks(frame["albedo"]), _blocks(frame["normal"])])
    return bool(void or float(looks.reshape(6, -1).std(1).sum()) > 0.25)


def _blocks(image: Array) -> Array:
    """Means of blocks ``(C, H / 8, W / 8)``; a smaller image is one block."""
    channels, height, width = image.shape
    high, wide = min(_BLOCK, height), min(_BLOCK, width)
    cut = image[:, : height // high * high, : width // wide * wide]
    return np.asarray(cut.reshape(channels, height // high, high, width // wide, wide).mean((2, 4)))


def _level(reference: Array) -> float:
    """The factor, a power of two, that makes a reference's typical radiance a middle gray."""
    light = reference.mean(0)
    lit = light[light > 1e-3 * float(light.mean())]
    typical = float(np.exp(np.log(lit).mean())) if lit.size else 1.0
    return float(2.0 ** np.round(np.log2(_MIDDLE / typical)))
