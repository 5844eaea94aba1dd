"""Color of the frames of a sequence, and features with positions, at pixel centres or on a film."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mcdenoise.data.camera_path import Array, Camera
from mcdenoise.scenes.render.film import Film
from mcdenoise.scenes.render.loading import Scene, Stage
from mcdenoise.scenes.render.tracer import ALBEDO, COLOR, NORMAL, REST, WAVEFRONT, Samples, Tracer

RR_DEPTH, STRATIFIED_PATHS = 5, 16
_SCALAR_PASS = 8
_LAYERS = 8


class SequenceTracer(Tracer):
    """The scene of a sequence.

    Args:
        scene: see :func:`mcdenoise.scenes.render.render_sequence`.
        variant: a variant of Mitsuba.
        moves: see :class:`mcdenoise.data.camera_path.CameraPath`.
        cameras: one a frame.
        size: width and height in pixels.
        film: filter and lens; without one all samples are at the pixel centre.
        max_depth: longest path, in segments.

    ``reach`` is the distance of the background in scene units.
    """

    def __init__(
        self,
        scene: Scene,
        variant: str,
        moves: Mapping[str, Array],
        cameras: Sequence[Camera],
        size: tuple[int, int],
        film: Film | None,
        max_depth: int,
    ) -> None:
        stage = Stage(scene, variant, moves)
        mi = stage.mitsuba
        bsdfs = [shape.bsdf() for shape in stage.scene.shapes()]
        # An instance has none of its own.
        clear = any(bsdf is None or mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in bsdfs)
        layers = _LAYERS if clear else 0
        super().__init__(stage, cameras, size, film or Film("centre"), (max_depth, RR_DEPTH), layers=layers)
        self.exact, self.reach = film is None, stage.reach(cameras)
        self.paths_per_pass = _SCALAR_PASS if stage.scalar else max(1, WAVEFRONT // (size[0] * size[1]))

    def frame(self, frame: int, paths: int, seed: Sequence[int]) -> dict[str, Array]:
        """Color of independent samples, and on a film features of the same, by buffer names, ``(H*W, C)``."""
        if self.exact:
            return {"color": self.radiance(frame, paths, seed)}
        return self._buffers(frame, self.trace(frame, paths, seed, even=self.film.spreads))

    def features(self, frame: int) -> dict[str, Array]:
        """Features at the pixel centres, by buffer names, ``(H*W, C)``."""
        return self._buffers(frame, self.trace(frame, 1, (0,), color=False, exact=True))

    def _buffers(self, frame: int, samples: Samples) -> dict[str, Array]:
        """Buffers; the background is at a distance behind everything, and has neither normal nor albedo."""
        pixels = self.pixels(samples)
        position, eye = pixels[:, REST : REST + 3], self._cameras[frame].to_world
        # Rounding makes some unit normals longer than 1; a few BSDFs' albedo exceeds 1.
        length = np.linalg.norm(pixels[:, NORMAL], axis=1, keepdims=True)
        found = {
            "color": pixels[:, COLOR],
            "albedo": np.clip(pixels[:, ALBEDO], 0, 1),
            "normal": pixels[:, NORMAL] / np.maximum(length, 1),
            "position": position,
            "depth": np.maximum((position - eye[:3, 3]) @ eye[:3, 2], 0),
        }
        return found | ({"previous_position": pixels[:, REST + 3 :]} if self._stage.moves else {})

    def _glossy(self, hit: Any, bsdf: Any, diffuse: Any) -> Any:
        """Directional albedo of rough metals towards the viewer, by a fixed 4x4 grid of samples, so without noise."""
        mi, dr = self._mi, self._dr
        # Use select instead of ~diffuse, which is not a logical negation for a Python bool.
        rough = dr.select(diffuse, False, mi.has_flag(bsdf.flags(), mi.BSDFFlags.GlossyReflection)) & hit.is_valid()
        if self._scalar and not rough:
            return mi.Color3f(0)
        # Evaluate the inputs first; otherwise each sample would trace the rays again.
        dr.eval(hit, rough)
        total = mi.Color3f(0)
        grid = [(i + 0.5) / 4 for i in range(4)] if dr.any(rough) else []
        for x in grid:
            for y in grid:
                # Evaluate one sample at a time with opaque inputs: one small kernel, used 16 times.
                point = mi.Point2f(dr.opaque(mi.Float, x), dr.opaque(mi.Float, y))
                total += bsdf.sample(mi.BSDFContext(), hit, 0.5, point, rough)[1]
                dr.eval(total)
        return total / 16

    def _rest(self, ray: Any, hit: Any, valid: Any, shot: Any) -> list[Any]:
        """Position, and where the point was in the previous frame if anything moves."""
        mi, dr = self._mi, self._dr
        far = ray.o + (self.reach if self._scalar else dr.opaque(mi.Float, self.reach)) * ray.d
        positions = [hit.p, self._earlier(hit, shot)] if self._stage.moves else [hit.p]
        return [channel for position in positions for channel in dr.select(valid, position, far)]
