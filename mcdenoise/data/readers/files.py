"""Frames as renderers write them: one EXR with many layers, or one file per buffer, with arbitrary names."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.data.camera_matrices import MATRICES, Array, CameraMatrices
from mcdenoise.data.exr import Image, Mask, Metadata
from mcdenoise.data.images import EXR_SUFFIXES, Part, Window, read_channels, read_image_header
from mcdenoise.data.readers.cameras import fit_camera
from mcdenoise.data.readers.choice import Choice
from mcdenoise.data.readers.diffuse_specular import Split
from mcdenoise.data.readers.layers import GREY, Layer
from mcdenoise.data.readers.lights import Light, is_light, keeps, kept_together, stored
from mcdenoise.data.readers.names import FileGroup
from mcdenoise.data.readers.rewrite import write_like
from mcdenoise.data.readers.samples import SampleLayers
from mcdenoise.data.readers.transfer import decode
from mcdenoise.data.readers.values import Row, nothing_hit
from mcdenoise.errors import InputError
from mcdenoise.frame import BUFFERS, Frame, scale_samples
from mcdenoise.motion import USUAL_MOTION, Convention, convert

# Buffers of light and reflectance, which a PNG stores with a transfer function; it stores normals without.
_LIGHT = {"color", "albedo", "reference", "diffuse", "specular", "specular_albedo", "emission"}
# Distance of the sky relative to everything else.
_SKY = 1000.0
# Lossy compression may change black to a negative value of at most this size.
_LOSSY = 1e-3


@dataclass
class RenderedFiles:
    """Frames of one shot; made by :func:`open_files`.

    Args:
        groups: the kinds of files.
        parts: the parts of the first file of each kind.
        numbers: frames in use, ascending.
        choice: the layer of each buffer.
        lights: additive layers of radiance, which are denoised with the color, by name.
        cameras: contents of a ``camera_matrices.h`` beside the files.
        color_has_albedo: whether the radiance includes the albedo.
        split: the layers of diffuse and specular light, if they add up to the color.
        samples: the layers of single samples, if their mean is the color.
        window: the smallest window with the data windows of all colors, if there is one that differs from another.
    """

    groups: Sequence[FileGroup]
    parts: Sequence[tuple[Part, ...]]
    numbers: list[int]
    choice: Choice
    lights: Mapping[str, Light]
    cameras: CameraMatrices | None = None
    color_has_albedo: bool = True
    encoded_normals: bool = False
    motion: Convention = USUAL_MOTION
    camera_convention: str = ""
    positions_of_camera: bool = False
    has_camera: bool = False
    drops_positions: bool = False
    split: Split | None = None
    samples: SampleLayers | None = None
    window: Window | None = None
    table: list[Row] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    noise_seeds: int = 1

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.part(self.choice.layers["color"]).size if self.window is None else self.window.size

    @property
    def buffers(self) -> frozenset[str]:
        """Names of the buffers that every frame has."""
        present = {
            name
            for name, layer in self.choice.layers.items()
            if all(number in self.groups[layer.group].files for number in self.numbers)
        }
        if len(self.choice.layers["color"].channels) > 3:
            present.add("alpha")
        if self.window is not None:
            present.add("mask")
        if "position" in present and (self.has_camera or self.cameras is not None):
            present |= {"view_projection", "depth"}
        elif self.cameras is not None:
            present.add("view_projection")
        if self.drops_positions:
            present -= {"position", "view_projection"}
        if self.split is not None:
            present |= self.split.names
        if self.samples is not None:
            present.add("samples")
        return frozenset(present)

    @property
    def folders(self) -> set[Path]:
        """The folders of the files."""
        return {path.parent for group in self.groups for path in group.files.values()}

    @property
    def unused(self) -> list[str]:
        """Layers that look like buffers but are not used."""
        lit = self._lit
        return [layer.place for layer in self.choice.unused if layer not in lit]

    @property
    def unknown(self) -> list[str]:
        """Layers with unknown names that the user has not requested."""
        lit = self._lit
        return [layer.place for layer in self.choice.unknown if layer not in lit and not is_light(layer)]

    @property
    def _lit(self) -> set[Layer]:
        """Layers that are used as light or as its color."""
        of_split = [] if self.split is None else self.split.layers.values()
        return {*(layer for light in self.lights.values() for layer in light.layers), *of_split}

    @property
    def reference_numbers(self) -> list[int]:
        """Frames in use that have a reference."""
        layer = self.choice.layers.get("reference")
        return [] if layer is None else [n for n in self.numbers if n in self.groups[layer.group].files]

    def frame_files(self, number: int) -> list[Path]:
        """The files of one frame with layers in use, without files that hold only a reference."""
        used = {layer.group for name, layer in self.choice.layers.items() if name != "reference"}
        used |= {layer.group for layer in (*self.choice.written, *self._lit)}
        used |= {layer.group for layer in (self.samples.layers.values() if self.samples else ())}
        own = [self.groups[group].files[number] for group in used if number in self.groups[group].files]
        cameras = [folder / MATRICES for folder in self.folders] if self.cameras is not None else []
        return own + [path for path in cameras if path.is_file()]

    def metadata(self, number: int) -> Metadata:
        """Attributes of one frame's color file."""
        return read_image_header(self.file(self.choice.layers["color"], number)).metadata

    def reference(self, number: int) -> Tensor:
        """Read the reference of one frame that has one."""
        return _tensor(self.read(number, {"reference": self.choice.layers["reference"]})["reference"][..., :3])

    def frame(
        self, number: int, *, reference: bool = True, noise_seed: int = 0, buffers: Collection[str] | None = None
    ) -> Frame:
        """Read one frame; see :meth:`mcdenoise.data.Sequence.frame`."""
        split = self.split if buffers is None or self.split is None or self.split.names & set(buffers) else None
        wanted = {
            name: layer
            for name, layer in self.choice.layers.items()
            if number in self.groups[layer.group].files and (reference or name != "reference")
        }
        samples = self.samples if buffers is None or "samples" in buffers else None
        wanted |= {} if split is None else split.layers
        wanted |= {} if samples is None else samples.layers
        wanted |= {f"{name} {i}": each for name, own in self.lights.items() for i, each in enumerate(own.layers)}
        images = self.read(number, wanted)
        lights = {
            name: _without_lossy_black(own.radiance([images.pop(f"{name} {i}") for i in range(len(own.layers))]))
            for name, own in self.lights.items()
        }
        if split is not None:
            read = {key: images.pop(key) for key in split.layers}
            parts = split.buffers(read, images["color"][..., :3])
            if parts is None:
                warnings.warn(
                    f"frame {number}: {', '.join(sorted(split.parts))} do not add up to the color as in the first "
                    "frame; not used",
                    stacklevel=2,
                )
            images |= {} if parts is None else parts
        several = None if samples is None else samples.samples({key: images.pop(key) for key in samples.layers})
        frame = self._as_frame(number, images, lights)
        if several is None:
            return frame
        single = torch.from_numpy(several)[None]
        if not self.color_has_albedo and frame.albedo is not None:
            single = scale_samples(single, frame.albedo)
        return frame.replace(samples=single)

    def check_output_layer(self, name: str) -> None:
        """See :meth:`mcdenoise.data.Sequence.check_output_layer`."""
        layer = self.choice.written[0]
        path = self.file(layer, self.numbers[0])
        if path.suffix.lower() not in EXR_SUFFIXES:
            raise InputError(f"{path}: expected an EXR to add a layer to, found '{path.suffix}'; replace its picture")
        if not name.strip() or "." in name or not name.isprintable():
            raise InputError(f"--output-layer: expected a name without dots, found {name!r}")
        prefix = ".".join((*layer.family, name))
        taken = [each for each in self.part(layer).channels if each == prefix or each.startswith(f"{prefix}.")]
        if taken:
            raise InputError(
                f"{path}: expected a new name for --output-layer, found '{taken[0]}' in the file; choose another"
            )

    def write(
        self,
        out: Path,
        number: int,
        image: Image,
        *,
        alpha: Image | None = None,
        lights: Mapping[str, Image] | None = None,
        output_layer: str | None = None,
        full_float: bool = False,
    ) -> Path:
        """Write the files of a frame with the denoised image; see :meth:`mcdenoise.data.Sequence.write`."""
        layer = self.choice.written[0]
        files: defaultdict[int, dict[tuple[int, str], Image]] = defaultdict(dict)
        inside: dict[tuple[int, str], Image] = {}
        if output_layer is not None:
            grey = len(layer.channels) == 1
            names = [".".join((*layer.family, output_layer, letter)) for letter in ("Y" if grey else "RGB")]
            planes = image.mean(-1, keepdims=True) if grey else image
            inside = {(layer.part, name): planes[..., i] for i, name in enumerate(names)}
        for each in self.choice.written if output_layer is None else ():
            matrix = self.choice.converted.get(each)
            if matrix is not None:
                planes = (image @ matrix.T).astype(np.float32)
            else:
                planes = image.mean(-1, keepdims=True) if len(each.channels) == 1 else image
            files[each.group] |= {(each.part, name): planes[..., i] for i, name in enumerate(each.channels[:3])}
        if alpha is not None:
            own = layer if len(layer.channels) > 3 else self.choice.layers["alpha"]
            files[own.group][own.part, own.channels[3 if own == layer else 0]] = alpha[..., 0]
        for group, channels in self._lights(number, lights or {}).items():
            files[group] |= channels
        for group in {layer.group, *files}:
            source, ours = self.groups[group].files[number], group == layer.group
            target = out / source.name
            write_like(
                *(source, target, self._cropped(source, files[group])),
                added={key[1]: pixels for key, pixels in self._cropped(source, inside).items()} if ours else {},
                part=layer.part,
                like=layer.channels[0],
                full_float=full_float,
                stored=self.parts[group][0],
            )
        return out / self.file(layer, number).name

    def _cropped(self, path: Path, channels: dict[tuple[int, str], Image]) -> dict[tuple[int, str], Image]:
        """The pixels of channels in the data windows of a file."""
        if self.window is None:
            return channels
        parts = read_image_header(path).parts
        return {key: parts[key[0]].window.of(pixels, self.window) for key, pixels in channels.items()}

    def _lights(self, number: int, radiances: Mapping[str, Image]) -> dict[int, dict[tuple[int, str], Image]]:
        """For each kind of file, the channels of its layers of light for given denoised radiances."""
        if not radiances:
            return {}
        colors = self.read(
            number, {name: self.lights[name].layers[1] for name in radiances if self.lights[name].layers[1:]}
        )
        held = kept_together(radiances, {name: keeps(colors.get(name)) for name in radiances})
        files: defaultdict[int, dict[tuple[int, str], Image]] = defaultdict(dict)
        for name, radiance in held.items():
            layer, pixels = self.lights[name].layers[0], stored(radiance, colors.get(name))
            files[layer.group] |= {(layer.part, each): pixels[..., i] for i, each in enumerate(layer.channels[:3])}
        return files

    def _as_frame(self, number: int, images: dict[str, Image], lights: Mapping[str, Image]) -> Frame:
        color = images["color"]
        if color.shape[2] > 3:
            images.setdefault("alpha", np.clip(color[..., 3:4], 0, 1))
        images["color"] = _without_lossy_black(color[..., :3])
        if "mask" in images and (images["mask"] > 0).any():
            # A matte of an object is called a mask, too: beside it there is light.
            images["mask"] = np.where((images["color"] > 0).any(-1, keepdims=True), 1, images["mask"] > 0).astype(
                np.float32
            )
        if self.window is not None:
            own = self.window_of(self.choice.layers["color"], number)
            inside = self.window.of(np.ones((*own.size, 1), np.float32), own)
            images["mask"] = np.minimum(images.get("mask", inside), inside)
        seen = seen_of(images)
        if "albedo" in images:
            images["albedo"] = np.clip(np.nan_to_num(images["albedo"], nan=0, posinf=1, neginf=0), 0, 1)
            if not self.color_has_albedo:
                images["color"] = images["color"] * images["albedo"]
        if "normal" in images:
            normal = np.nan_to_num(images["normal"], nan=0, posinf=0, neginf=0)
            if self.encoded_normals:
                normal = np.where((normal != 0).any(-1, keepdims=True), 2 * normal - 1, 0)
            images["normal"] = np.clip(normal, -1, 1)
        if "motion" in images:
            images["motion"] = motion = self.motion.apply(images["motion"])
            if seen is not None and motion.any():
                # Renderers that track surfaces write 0 where there is none, even if the camera moves.
                images["motion"] = np.where(seen | (motion != 0), motion, np.float32(np.inf))
        matrix = self.camera(number, images, seen)
        if matrix is not None and "position" in images:
            known = hit(images, seen)
            position = np.where(known[..., None], images["position"], 0)
            # In double precision, without converting all positions to it at once.
            w = np.einsum("hwc,c->hw", position, matrix[:3, 3]) + matrix[3, 3]
            images.setdefault("depth", np.where(known & (w > 0), w, 0)[..., None].astype(np.float32))
            position[~known] = _far_points(matrix, float(w[known].max(initial=1)), ~known)
            images["position"] = position
            seen = ~nothing_hit(images["depth"])
        if self.drops_positions or matrix is None:
            images.pop("position", None)
        buffers: dict[str, Any] = {name: _tensor(image) for name, image in images.items() if name in BUFFERS}
        if matrix is not None and not self.drops_positions:
            buffers["view_projection"] = torch.from_numpy(matrix).float()[None]
        if seen is not None:
            buffers["depth"] = _tensor(np.where(seen, images["depth"], np.inf))
        return Frame(**buffers, layers={name: _tensor(radiance) for name, radiance in lights.items()})

    def camera(self, number: int, images: Mapping[str, Image], seen: Mask | None) -> Array | None:
        """The world-to-clip matrix of a frame: the given one, or one fitted to its positions."""
        if self.cameras is not None:
            return convert(self.cameras.view_projection(number, self.size), self.camera_convention)
        if not self.has_camera or "position" not in images:
            return None
        found = fit_camera(images["position"], hit(images, seen))
        return None if found is None else found.matrix

    def part(self, layer: Layer) -> Part:
        """The part that contains a layer, in the first file of its kind."""
        return self.parts[layer.group][layer.part]

    def file(self, layer: Layer, number: int) -> Path:
        """The file that contains a layer of a frame."""
        return self.groups[layer.group].files[number]

    def window_of(self, layer: Layer, number: int) -> Window:
        """The data window of a layer in a frame."""
        return read_image_header(self.file(layer, number)).parts[layer.part].window

    def read(self, number: int, layers: Mapping[str, Layer]) -> dict[str, Image]:
        """Read layers of one frame, opening each file once."""
        files: defaultdict[Path, dict[int, list[str]]] = defaultdict(lambda: defaultdict(list))
        for layer in layers.values():
            channels = files[self.file(layer, number)][layer.part]
            channels += [channel for channel in layer.channels if channel not in channels]
        images: dict[str, Image] = {}
        for path, wanted in files.items():
            found = read_channels(path, wanted)
            for name, layer in layers.items():
                if self.file(layer, number) == path:
                    pixels = found[layer.part][..., [wanted[layer.part].index(c) for c in layer.channels]]
                    if self.window is not None:
                        # Nothing was hit there.
                        fill = np.inf if name == "depth" else 0.0
                        pixels = self.window.of(pixels, self.window_of(layer, number), fill)
                    images[name] = self._decoded(name, layer, pixels, path)
        if self.positions_of_camera and "position" in images:
            images["position"] = self.in_world(number, images["position"])
        return images

    def in_world(self, number: int, position: Image) -> Image:
        """Convert camera-space positions to world space by the attribute ``worldToCamera``; 0 is no position."""
        to_camera = world_to_camera(self.metadata(number))
        if to_camera is None:
            raise InputError(
                f"{self.file(self.choice.layers['color'], number)}: expected the attribute 'worldToCamera', as "
                "the first file has it, found none; leave positions out with --map position="
            )
        homogeneous = np.concatenate([position, np.ones_like(position[..., :1])], -1)
        world = (homogeneous @ np.linalg.inv(to_camera))[..., :3]
        return np.where((position != 0).any(-1, keepdims=True), world, 0).astype(np.float32)

    def _decoded(self, name: str, layer: Layer, pixels: Image, path: Path) -> Image:
        if pixels.shape[:2] != self.size:
            (height, width), (found_height, found_width) = self.size, pixels.shape[:2]
            raise InputError(
                f"{path}: expected {width} x {height} pixels like the first color file, found "
                f"{found_width} x {found_height}; render all buffers and frames at one size"
            )
        # Layers of light are not buffers.
        if self.part(layer).display_referred and (name in _LIGHT or name not in BUFFERS):
            pixels = np.concatenate([decode(pixels[..., :3], self.part(layer).gamma), pixels[..., 3:]], -1)
        channels = BUFFERS[name].channels if name in BUFFERS else 3
        if name in GREY and pixels.shape[2] == 1:
            return np.repeat(pixels, 3, -1)
        if name in ("color", "motion"):
            return pixels
        if name == "variance" and pixels.shape[2] < 3:
            return np.repeat(pixels[..., :1], 3, -1)
        return pixels[..., :channels]


def _without_lossy_black(radiance: Image) -> Image:
    """Remove small negative values that rounding and lossy compression leave in black pixels."""
    clean: Image = np.where((radiance < 0) & (radiance > -_LOSSY), 0, radiance)
    return clean


def seen_of(images: Mapping[str, Image]) -> Mask | None:
    """``(H, W, 1)`` true where the depth shows a hit; ``None`` without a depth."""
    return ~nothing_hit(images["depth"]) if "depth" in images else None


def hit(images: Mapping[str, Image], seen: Mask | None) -> Mask:
    """``(H, W)`` true where something was hit: by the depth, or without one by the position."""
    position = images["position"]
    known: Mask = np.isfinite(position).all(-1) & ((position != 0).any(-1) if seen is None else seen[..., 0])
    return known


def world_to_camera(metadata: Metadata) -> Array | None:
    """The row-vector matrix in a file's attribute, whichever way it is stored there."""
    for name, value in metadata.items():
        if name.lower() == "worldtocamera" and isinstance(value, tuple) and len(value) == 16:
            matrix = np.reshape(np.array(value, np.float64), (4, 4))
            for each in (matrix, matrix.T):
                if np.allclose(each[:, 3], (0, 0, 0, 1), atol=1e-4) and abs(np.linalg.det(each)) > 1e-12:
                    return each
    return None


def _far_points(matrix: Array, depth: float, sky: Mask) -> Array:
    """``(N, 3)`` points far behind all others for pixels of the sky, so that the sky can be reprojected."""
    (height, width), (rows, columns) = sky.shape, np.nonzero(sky)
    screen = np.stack([(columns + 0.5) / width * 2 - 1, (rows + 0.5) / height * 2 - 1, np.ones(len(rows))], -1)
    columns_used = matrix[:, [0, 1, 3]]
    result: Array = (_SKY * depth * screen - columns_used[3]) @ np.linalg.pinv(columns_used[:3])
    return result


def _tensor(image: Image) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image, dtype=np.float32)).permute(2, 0, 1)[None].contiguous()
