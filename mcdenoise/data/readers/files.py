"""Frames as renderers write them: one EXR with many layers, or one file per buffer, with arbitrary names."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from mcdenoise.data.camera_matrices import MATRICES, CameraMatrices
from mcdenoise.data.images import EXR_SUFFIXES, Image, Mask, Metadata, Part, Window, read_image_header
from mcdenoise.data.radiance import light_of
from mcdenoise.data.readers.cameras import fit_camera
from mcdenoise.data.readers.choice import Choice
from mcdenoise.data.readers.diffuse_specular import NO_SPLIT, Split
from mcdenoise.data.readers.layers import GREY, Layer, read_files
from mcdenoise.data.readers.lights import is_light, stored
from mcdenoise.data.readers.names import FileGroup
from mcdenoise.data.readers.rewrite import write_like
from mcdenoise.data.readers.samples import NO_SAMPLES, SampleLayers
from mcdenoise.data.readers.sequence import Denoised
from mcdenoise.data.readers.sequence import Sequence as FrameSequence
from mcdenoise.data.readers.values import nothing_hit
from mcdenoise.errors import InputError
from mcdenoise.frame import BUFFERS, Frame, Hints, scale_samples
from mcdenoise.motion import USUAL_MOTION, Array, Convention, convert

# Buffers of light and reflectance, which a PNG stores with a transfer function; it stores normals without.
_LIGHT = {"color", "albedo", "reference", "diffuse", "specular", "specular_albedo", "emission"}
# Distance of the sky relative to everything else.
SKY = 1000.0
# Lossy compression may change black to a negative value of at most this size.
_LOSSY = 1e-3


@dataclass
class RenderedFiles(FrameSequence):
    """Frames of one shot; made by :func:`mcdenoise.data.readers.opening.open_files`.

    Args:
        groups: the kinds of files.
        parts: the parts of the first file of each kind.
        choice: the layer of each buffer.
        cameras: contents of a ``camera_matrices.h`` beside the files.
        encoded_normals: whether normals are stored as ``n / 2 + 1 / 2``.
        negative_depths: whether depths in front of the camera are stored as negative numbers.
        motion: how motion is stored.
        camera_convention: how the matrices of ``cameras`` are stored, see :func:`mcdenoise.motion.read_as`.
        positions_of_camera: whether positions are in the space of the camera, and brought to the world.
        has_camera: whether a camera can be found for each frame.
        drops_positions: whether positions tell no more than a depth, or nothing.
        split: the layers of diffuse and specular light, if they add up to the color.
        samples: the layers of single samples, if their mean is the color.
        more: the kinds of files for each further noise seed.
        examined: number of the frame that told all this.
    """

    groups: Sequence[FileGroup]
    parts: Sequence[tuple[Part, ...]]
    choice: Choice
    cameras: CameraMatrices | None = None
    encoded_normals: bool = False
    negative_depths: bool = False
    motion: Convention = USUAL_MOTION
    camera_convention: str = ""
    positions_of_camera: bool = False
    has_camera: bool = False
    drops_positions: bool = False
    split: Split = NO_SPLIT
    samples: SampleLayers = NO_SAMPLES
    more: Sequence[Sequence[FileGroup]] = ()
    examined: int = 0
    # Whether a camera is found from positions where none is given, and data windows must not differ.
    fits_cameras: ClassVar[bool] = True
    one_window: ClassVar[bool] = False

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return (self.window or self.part_of(self.choice.layers["color"]).window).size

    @property
    def buffers(self) -> frozenset[str]:
        """Names of the buffers that every frame has."""
        present = {name for name, layer in self.choice.layers.items() if all(self.has(layer, n) for n in self.numbers)}
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
        return frozenset(present | self.split.names | ({"samples"} if self.samples.radiance else set()))

    @property
    def noise_seeds(self) -> int:
        """Number of noisy colors per frame."""
        return 1 + len(self.more)

    @property
    def folders(self) -> set[Path]:
        """The folders of the files."""
        return {path.parent for group in self.groups for path in group.files.values()}

    @property
    def unused(self) -> list[str]:
        """Layers that look like buffers but are not used."""
        return [layer.place for layer in self.choice.unused if layer not in self._further]

    @property
    def unknown(self) -> list[str]:
        """Layers with unknown names that the user has not requested."""
        return [layer.place for layer in self.choice.unknown if layer not in self._further and not is_light(layer)]

    @property
    def _further(self) -> set[Layer]:
        """The layers of light and of samples, and the colors that light is divided by."""
        found = {layer for light in self.lights.values() for layer in light.layers}
        return found | self.split.layers | self.samples.layers

    @property
    def reference_numbers(self) -> list[int]:
        """Frames in use that have a reference."""
        layer = self.choice.layers.get("reference")
        return [] if layer is None else [number for number in self.numbers if self.has(layer, number)]

    def _files(self, number: int) -> list[Path]:
        """The files of one frame with layers in use, without files that hold only a reference."""
        used = {layer for name, layer in self.choice.layers.items() if name != "reference"}
        groups = {layer.group for layer in {*used, *self.choice.written, *self._further} if self.has(layer, number)}
        cameras = [folder / MATRICES for folder in self.folders] if self.cameras is not None else []
        return [self.groups[group].files[number] for group in groups] + [path for path in cameras if path.is_file()]

    def _metadata(self, number: int) -> Metadata:
        return read_image_header(self.file(self.choice.layers["color"], number)).metadata

    def _frame(self, number: int, reference: bool, noise_seed: int, buffers: Collection[str] | None) -> Frame:
        if noise_seed:
            return replace(self, groups=self.more[noise_seed - 1])._frame(number, reference, 0, buffers)
        split = self.split if buffers is None or self.split.names & set(buffers) else NO_SPLIT
        samples = self.samples if buffers is None or "samples" in buffers else NO_SAMPLES
        names = [
            name
            for name, layer in self.choice.layers.items()
            if self.has(layer, number) and (reference or name != "reference")
        ]
        wanted = {layer for light in self.lights.values() for layer in light.layers}
        wanted |= split.layers | samples.layers
        pixels = self.read(number, [*wanted, *(self.choice.layers[name] for name in names)])
        images = {name: self.as_buffer(number, name, pixels[self.choice.layers[name]]) for name in names}
        lights = {name: _without_lossy_black(light.radiance(pixels)) for name, light in self.lights.items()}
        if split.parts:
            parts = split.buffers(pixels, images["color"][..., :3])
            if parts is None:
                warnings.warn(
                    f"frame {number}: {', '.join(sorted(split.parts))} do not add up to the color as in the first "
                    "frame; not used",
                    stacklevel=2,
                )
            images |= parts or {}
        single = torch.from_numpy(samples.samples(pixels))[None] if samples.radiance else None
        del pixels
        frame = self.as_frame(number, images, lights)
        if single is not None and not self.color_has_albedo and frame.albedo is not None:
            single = scale_samples(single, frame.albedo)
        return frame if single is None else frame.replace(samples=single)

    def check_output_layer(self, name: str) -> None:
        """Check that the file has the layer to add a layer to, and none of this name."""
        layer = self.choice.written[0]
        path = self.file(layer, self.numbers[0])
        if path.suffix.lower() not in EXR_SUFFIXES:
            raise InputError(f"{path}: expected an EXR to add a layer to, found '{path.suffix}'; replace its picture")
        if not name.strip() or "." in name or not name.isprintable():
            raise InputError(f"--output-layer: expected a name without dots, found {name!r}")
        prefix = ".".join((*layer.family, name))
        taken = [each for each in self.part_of(layer).channels if each == prefix or each.startswith(f"{prefix}.")]
        if taken:
            raise InputError(
                f"{path}: expected a new name for --output-layer, found '{taken[0]}' in the file; choose another"
            )

    def _write(self, out: Path, number: int, result: Denoised) -> Path:
        image, alpha, lights, output_layer, full_float = result
        layer = self.choice.written[0]
        files: defaultdict[int, dict[tuple[int, str], Image]] = defaultdict(dict)
        places: dict[Layer, Sequence[str]] = {each: each.channels[:3] for each in self.choice.written}
        if output_layer is not None:
            letters = "Y" if len(layer.channels) == 1 else "RGB"
            places = {layer: [".".join((*layer.family, output_layer, letter)) for letter in letters]}
        for each, names in places.items():
            planes = image.mean(-1, keepdims=True) if len(names) == 1 else image
            if (matrix := self.choice.converted.get(each)) is not None:
                planes = (image @ matrix.T).astype(np.float32)
            files[each.group] |= {(each.part, name): planes[..., i] for i, name in enumerate(names)}
        if alpha is not None:
            own = layer if len(layer.channels) > 3 else self.choice.layers["alpha"]
            files[own.group][own.part, own.channels[3 if own == layer else 0]] = alpha[..., 0]
        for group, channels in self._lights(number, lights).items():
            files[group] |= channels
        sources = {group: self.groups[group].files[number] for group in {layer.group, *files}}
        targets: dict[str, Path] = {}
        for source in sources.values():
            if (other := targets.setdefault(self.target(source), source)) != source:
                raise InputError(
                    f"{source}: expected a name that no other file to write has, found that of {other}; rename one"
                )
        for group, source in sources.items():
            write_like(
                *(source, out / self.target(source), self._cropped(source, files[group])),
                like=layer.channels[0],
                full_float=full_float,
                stored=self.parts[group][0],
            )
        return out / self.target(self.file(layer, number))

    def target(self, source: Path) -> str:
        """The name of the file that is written for one of the color, of light or of alpha."""
        return source.name

    def _cropped(self, path: Path, channels: dict[tuple[int, str], Image]) -> dict[tuple[int, str], Image]:
        """The pixels of channels in the data windows of a file."""
        if self.window is None:
            return channels
        parts = read_image_header(path).parts
        return {key: parts[key[0]].window.of(pixels, self.window) for key, pixels in channels.items()}

    def _lights(self, number: int, radiances: Mapping[str, Image]) -> dict[int, dict[tuple[int, str], Image]]:
        """For each kind of file, the channels of its layers of light for given denoised radiances."""
        divisors = {name: self.lights[name].color for name in radiances}
        pixels = self.read(number, [layer for layer in divisors.values() if layer is not None])
        colors = {name: None if layer is None else pixels[layer][..., :3] for name, layer in divisors.items()}
        files: defaultdict[int, dict[tuple[int, str], Image]] = defaultdict(dict)
        for name, planes in (stored(radiances, colors) if radiances else {}).items():
            layer = self.lights[name].layers[0]
            files[layer.group] |= {(layer.part, each): planes[..., i] for i, each in enumerate(layer.channels[:3])}
        return files

    def as_frame(self, number: int, images: dict[str, Image], lights: Mapping[str, Image]) -> Frame:
        """A frame of stored images, which are converted to this package's conventions."""
        color = images["color"]
        if color.shape[2] > 3:
            images.setdefault("alpha", color[..., 3:4])
        if "alpha" in images:
            # A pixel filter may have negative lobes, and a sample that is NaN has hit something.
            images["alpha"] = np.clip(np.nan_to_num(images["alpha"], nan=1), 0, 1)
        images["color"] = _without_lossy_black(color[..., :3])
        # Where a sample was NaN, the color is filled from around.
        for name in {"variance", "roughness"} & images.keys():
            images[name] = np.nan_to_num(images[name], nan=0, posinf=0, neginf=0)
        if "mask" in images:
            # A matte of an object is called a mask, too: beside it there is light.
            images["mask"] = np.where((images["color"] > 0).any(-1, keepdims=True), 1, images["mask"] > 0).astype(
                np.float32
            )
        if self.window is not None:
            own = self.window_of(self.choice.layers["color"], number)
            inside = self.window.of(np.ones((*own.size, 1), np.float32), own)
            images["mask"] = np.minimum(images.get("mask", inside), inside)
        seen = ~nothing_hit(images["depth"]) if "depth" in images else None
        if "albedo" in images:
            images["albedo"] = np.clip(np.nan_to_num(images["albedo"]), 0, 1)
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
        matrix = self.camera(number, images)
        if matrix is not None and "position" in images:
            known = self.known(images)
            position = np.where(known[..., None], images["position"], 0)
            # In double precision, without converting all positions to it at once.
            w = np.einsum("hwc,c->hw", position, matrix[:3, 3]) + matrix[3, 3]
            images.setdefault("depth", np.where(known & (w > 0), w, 0)[..., None].astype(np.float32))
            position[~known] = far_points(matrix, float(w[known].max(initial=1)), ~known)
            images["position"] = position
            seen = ~nothing_hit(images["depth"])
        if self.drops_positions or matrix is None:
            images.pop("position", None)
        if seen is not None:
            images["depth"] = np.where(seen, images["depth"], np.inf)
        buffers = as_tensors(images, None if self.drops_positions else matrix)
        # They are the ratio of light and alpha, which only both together can keep.
        hints = Hints(alpha=self.part_of(self.choice.layers["color"]).straight)
        return Frame(**buffers, layers={name: as_tensor(light) for name, light in lights.items()}, hints=hints)

    def known(self, images: Mapping[str, Image]) -> Mask:
        """``(H, W)`` true where something was hit: by the depth, or without one by the position."""
        position = images["position"]
        hit = ~nothing_hit(images["depth"])[..., 0] if "depth" in images else (position != 0).any(-1)
        known: Mask = np.isfinite(position).all(-1) & hit
        return known

    def camera(self, number: int, images: Mapping[str, Image]) -> Array | None:
        """The world-to-clip matrix of a frame: the given one, or one fitted to its positions."""
        if self.cameras is not None:
            return convert(self.cameras.view_projection(number, self.size), self.camera_convention)
        if not self.has_camera or "position" not in images:
            return None
        found = fit_camera(images["position"], self.known(images))
        return None if found is None else found.matrix

    def part_of(self, layer: Layer) -> Part:
        """The part that contains a layer, in the first file of its kind."""
        return self.parts[layer.group][layer.part]

    def file(self, layer: Layer, number: int) -> Path:
        """The file that contains a layer of a frame."""
        return self.groups[layer.group].files[number]

    def window_of(self, layer: Layer, number: int) -> Window:
        """The data window of a layer in a frame."""
        return read_image_header(self.file(layer, number)).parts[layer.part].window

    def has(self, layer: Layer, number: int) -> bool:
        """Whether a frame has the file of a layer."""
        return number in self.groups[layer.group].files

    def read(self, number: int, layers: Iterable[Layer]) -> dict[Layer, Image]:
        """Read layers of one frame, opening each file once: linear light, in the window of all frames."""
        images = read_files(lambda layer: self.file(layer, number), layers)
        return {layer: self._decoded(number, layer, pixels) for layer, pixels in images.items()}

    def read_buffers(self, number: int, names: Iterable[str]) -> dict[str, Image]:
        """Read the layers of buffers of one frame, with the channels of these."""
        layers = {name: self.choice.layers[name] for name in names}
        pixels = self.read(number, layers.values())
        return {name: self.as_buffer(number, name, pixels[layer]) for name, layer in layers.items()}

    def as_buffer(self, number: int, name: str, pixels: Image) -> Image:
        """The channels of a buffer; color and motion keep those that they have."""
        if name in GREY and pixels.shape[2] == 1:
            return np.repeat(pixels, 3, -1)
        if name in ("color", "motion"):
            return pixels
        pixels = pixels[..., : BUFFERS[name].channels]
        if name == "depth" and self.negative_depths:
            return -pixels
        return self.in_world(number, pixels) if name == "position" and self.positions_of_camera else pixels

    def in_world(self, number: int, position: Image) -> Image:
        """Convert camera-space positions to world space by the attribute ``worldToCamera``; 0 is no position."""
        to_camera = world_to_camera(self._metadata(number))
        if to_camera is None:
            raise InputError(
                f"{self.file(self.choice.layers['color'], number)}: expected the attribute 'worldToCamera', as "
                "the first file has it, found none; leave positions out with --map position="
            )
        homogeneous = np.concatenate([position, np.ones_like(position[..., :1])], -1)
        world = (homogeneous @ np.linalg.inv(to_camera))[..., :3]
        return np.where((position != 0).any(-1, keepdims=True), world, 0).astype(np.float32)

    def _decoded(self, number: int, layer: Layer, pixels: Image) -> Image:
        others = {own: name for name, own in self.choice.layers.items() if name not in _LIGHT}
        if self.window is not None:
            # Nothing was hit outside of the data window.
            fill = np.inf if others.get(layer) == "depth" else 0.0
            pixels = self.window.of(pixels, self.window_of(layer, number), fill)
        if pixels.shape[:2] != self.size:
            (height, width), (found_height, found_width) = self.size, pixels.shape[:2]
            raise InputError(
                f"{self.file(layer, number)}: expected {width} x {height} pixels like the first color file, found "
                f"{found_width} x {found_height}; render all buffers and frames at one size"
            )
        return pixels if layer in others else light_of(pixels, self.part_of(layer))


def _without_lossy_black(radiance: Image) -> Image:
    """Remove small negative values that rounding and lossy compression leave in black pixels."""
    clean: Image = np.where((radiance < 0) & (radiance > -_LOSSY), 0, radiance)
    return clean


def world_to_camera(metadata: Metadata) -> Array | None:
    """The row-vector matrix in a file's attribute, whichever way it is stored there."""
    for name, value in metadata.items():
        if name.lower() == "worldtocamera" and isinstance(value, tuple) and len(value) == 16:
            matrix = np.reshape(np.array(value, np.float64), (4, 4))
            for each in (matrix, matrix.T):
                if np.allclose(each[:, 3], (0, 0, 0, 1), atol=1e-4) and abs(np.linalg.det(each)) > 1e-12:
                    return each
    return None


def far_points(matrix: Array, depth: float, sky: Mask) -> Array:
    """``(N, 3)`` points far behind all others for pixels of the sky, so that the sky can be reprojected.

    Args:
        matrix: ``(4, 4)`` row-vector world-to-clip matrix, clip y down, clip w the depth along the view axis.
        depth: largest depth of all others.
        sky: ``(H, W)``, the pixels.
    """
    (height, width), (rows, columns) = sky.shape, np.nonzero(sky)
    screen = np.stack([(columns + 0.5) / width * 2 - 1, (rows + 0.5) / height * 2 - 1, np.ones(len(rows))], -1)
    columns_used = matrix[:, [0, 1, 3]]
    result: Array = (SKY * depth * screen - columns_used[3]) @ np.linalg.pinv(columns_used[:3])
    return result


def as_tensors(images: dict[str, Image], matrix: Array | None) -> dict[str, Any]:
    """Buffers and camera of a frame; images are taken out one after the other: a large frame is not held twice."""
    camera = {} if matrix is None else {"view_projection": torch.from_numpy(matrix).float()[None]}
    return camera | {name: as_tensor(images.pop(name)) for name in [*images] if name in BUFFERS}


def as_tensor(image: Image) -> Tensor:
    """``(1, C, H, W)`` of ``(H, W, C)``."""
    return torch.from_numpy(np.ascontiguousarray(image, dtype=np.float32)).permute(2, 0, 1)[None].contiguous()
