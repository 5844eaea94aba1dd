"""Single samples of a frame's pixels: layers ``sample0.RGB``, ``sample1.RGB``, ... of an EXR.

They are in the file of the color, or in a separate file per frame, such as ``samples_0001.exr``; in the BMFR layout it
is ``samplesN.exr``. Each sample may have its own features: ``sample0.albedo.RGB``, ``sample0.normal.XYZ`` and
``sample0.depth.Z``. Samples are used only if their mean is the color.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mcdenoise.data.exr import LARGEST_HALF, write_exr
from mcdenoise.data.images import Image
from mcdenoise.data.readers.layers import Layer
from mcdenoise.data.readers.lights import difference, is_same

# Channels after the radiance, in this order, if every sample has them.
FEATURES = {"albedo": "RGB", "normal": "XYZ", "depth": "Z"}
_NAME = re.compile(r"(?:.*[._ ])?sample[ _]?([0-9]{1,4})(?:\.(albedo|normal|depth))?", re.IGNORECASE)


@dataclass(frozen=True)
class SampleLayers:
    """The layers of the samples of a frame.

    Args:
        radiance: layer of each sample.
        features: layers of each sample by feature; only features that every sample has.
    """

    radiance: tuple[Layer, ...]
    features: Mapping[str, tuple[Layer, ...]]

    @property
    def layers(self) -> set[Layer]:
        """Every layer to read."""
        return {*self.radiance, *(layer for own in self.features.values() for layer in own)}

    def samples(self, images: Mapping[Layer, Image]) -> Image:
        """``(S, C, H, W)`` from the images of :attr:`layers`: radiance, followed by features."""
        rows = [(3, self.radiance), *((1 if name == "depth" else 3, own) for name, own in self.features.items())]
        found = [np.stack([images[layer][..., :count] for layer in own]) for count, own in rows]
        return np.ascontiguousarray(np.concatenate(found, -1).transpose(0, 3, 1, 2), dtype=np.float32)

    def __str__(self) -> str:
        features = f" with {', '.join(self.features)}" if self.features else ""
        return f"{len(self.radiance)} of a pixel{features}; their mean is the color"


NO_SAMPLES = SampleLayers((), {})


def split_samples(layers: Sequence[Layer]) -> tuple[SampleLayers, list[Layer]]:
    """Separate the layers of samples from all other layers: features of a sample are not buffers."""
    found: dict[str, dict[int, Layer]] = {}
    others = []
    for layer in layers:
        match = _NAME.fullmatch(layer.name)
        kind = (match[2] or "radiance").lower() if match else ""
        if match and (kind == "depth" or len(layer.channels) >= 3) and not layer.anonymous:
            found.setdefault(kind, {}).setdefault(int(match[1]), layer)
        else:
            others.append(layer)
    radiance = found.get("radiance", {})
    if not radiance:
        return NO_SAMPLES, list(layers)
    numbers = sorted(radiance)
    features = {
        name: tuple(found[name][n] for n in numbers) for name in FEATURES if found.get(name, {}).keys() >= {*numbers}
    }
    return SampleLayers(tuple(radiance[n] for n in numbers), features), others


def mean_is(color: Image, samples: Image) -> bool:
    """Whether the mean of samples ``(S, C, H, W)`` is the color ``(H, W, 3)``, up to the rounding of half floats."""
    return is_same(difference(samples[:, :3].mean(0, dtype=np.float64).transpose(1, 2, 0), color, 2))


def write_samples(path: Path, samples: Image) -> None:
    """Write samples as layers of an EXR.

    Args:
        path: the file.
        samples: ``(S, C, H, W)``: radiance, optionally followed by albedo, normal and depth.

    Raises:
        InputError: the file cannot be written.
    """
    suffixes = [*"RGB"]
    if samples.shape[1] > 3:
        suffixes += [f"{name}.{letter}" for name, letters in FEATURES.items() for letter in letters]
    names = [f"sample{i}.{suffix}" for i in range(len(samples)) for suffix in suffixes]
    finite = np.where(np.isfinite(samples), samples, 0)
    image = finite.reshape(-1, *samples.shape[2:]).transpose(1, 2, 0)
    write_exr(path, np.ascontiguousarray(image), names, full_float=bool(image.max(initial=0) > LARGEST_HALF))
