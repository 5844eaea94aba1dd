"""Denoising of multilayer EXR files by a graph in ONNX, with numpy, onnxruntime and OpenImageIO only."""

import os
from pathlib import Path

import numpy as np

try:
    from OpenImageIO import OpenImageIO as oiio  # Blender has the module in a folder of that name
except ImportError:
    import OpenImageIO as oiio

MODEL, SMOOTHER = (Path(__file__).with_name(name) for name in ("model.onnx", "smoother.onnx"))
# The passes of each buffer, the preferred one first, and their channels.
PASSES = {
    "color": (("Noisy Image", "Combined"), "RGB"),
    "albedo": (("Denoising Albedo",), "RGB"),
    "normal": (("Denoising Normal",), "XYZ"),
    "depth": (("Depth", "Z"), "Z"),
    "motion": (("Vector",), "XY"),
}
RESULT = "Combined"
# The passes of light, and the color by which Blender has divided each; to Blender 4, and from Blender 5 on.
LIGHTS = {
    **{f"{kind}{way}": f"{kind}Col" for kind in ("Diff", "Gloss", "Trans") for way in ("Dir", "Ind")},
    **{
        f"{kind} {way}": f"{kind} Color"
        for kind in ("Diffuse", "Glossy", "Transmission")
        for way in ("Direct", "Indirect")
    },
    **dict.fromkeys(("VolumeDir", "VolumeInd", "Emit", "Env")),
    **dict.fromkeys(("Volume Direct", "Volume Indirect", "Emission", "Environment")),
}
REST = ""  # the light of Combined that is in none of the passes
_DARKEST = 1e-3  # smallest color that light is divided by
# Relative rounding error of a sum of half floats, and the smallest of them.
_ROUNDING, _SMALLEST = 2.0**-9, 2.0**-24
_ROWS = 64  # converted at a time, in the cache of a core: in two thirds of the time
# Blender writes 1e10 where no surface is.
_FARTHEST, _BRIGHTEST = 1e9, 1e16


class FrameError(Exception):
    """A file cannot be read, lacks a pass, or cannot be written: one line."""


class Denoiser:
    """Denoises the frames of a shot one after the other, and keeps the graph's state between them."""

    def __init__(self):
        self._session, self._smoother = _session(MODEL), None
        self._outputs = [each.name for each in self._session.get_outputs()]
        self._state = {}

    def __call__(self, buffers):
        """The denoised radiance ``(H, W, 3)`` of buffers ``(H, W, C)`` by name, float32."""
        height, width, _ = buffers["color"].shape
        sizes = {"batch": 1, "height": height, "width": width}
        feeds = {}
        for given in self._session.get_inputs():
            if given.name in buffers:
                feeds[given.name] = _batch(buffers[given.name])
                continue
            shape, state = tuple(sizes.get(each, each) for each in given.shape), self._state.get(given.name)
            feeds[given.name] = np.zeros(shape, np.float32) if state is None or state.shape != shape else state
        image, *after = self._session.run(self._outputs, feeds)
        self._state = {name.removeprefix("next_"): each for name, each in zip(self._outputs[1:], after, strict=True)}
        return image[0].transpose(1, 2, 0)

    def split(self, buffers, image, lights):
        """Split the denoised image ``(H, W, 3)`` into parts for the noisy lights ``(H, W, 3)`` by name."""
        self._smoother = self._smoother or _session(SMOOTHER)
        given = {name: _batch(pixels) for name, pixels in {**buffers, "current": image}.items() if name != "motion"}
        smooth = {
            name: self._smoother.run(None, {**given, "diffuse": _batch(light)})[0] for name, light in lights.items()
        }
        return in_proportion(image, {name: light[0].transpose(1, 2, 0) for name, light in smooth.items()})


def in_proportion(image, lights):
    """Parts of an image ``(H, W, 3)`` in the proportion of lights, or of their means where all lights are black."""
    lights = {name: light.clip(0) for name, light in lights.items()}
    total, means = sum(lights.values()), {name: light.mean((0, 1)) for name, light in lights.items()}
    whole = sum(means.values())
    parts = {}
    for name, light in lights.items():
        mean = np.divide(means[name], whole, out=np.full_like(whole, 1 / len(lights)), where=whole > 0)
        parts[name] = image * np.divide(light, total, out=np.broadcast_to(mean, light.shape).copy(), where=total > 0)
    return parts


def closed(color, lights):
    """Lights ``(H, W, 3)`` by name that add up to the color, with what is left as :data:`REST`."""
    total = sum(lights.values())
    rest, least = color - total, _ROUNDING * color + (len(lights) + 1) * _SMALLEST
    none_left = (rest <= least).all()
    scale = np.divide(color, total, out=np.ones_like(color), where=(total > 0) & ((rest < 0) | none_left))
    return {name: light * scale for name, light in lights.items()} | {REST: np.where(none_left, 0, rest.clip(0))}


def denoise_frame(denoise, source, target, layer, *, blurred=False, lights=False):
    """Write a copy of a multilayer EXR whose Combined is denoised; everything else is unchanged.

    Args:
        denoise: a :class:`Denoiser`.
        source: the rendered file.
        target: the file to write; its folder is made.
        layer: name of the view layer.
        blurred: whether there is motion blur, with which Blender's Vector has zeros: then a frame is denoised alone.
        lights: whether the passes of light are denoised too, so that they add up to the image.

    Raises:
        FrameError: the file cannot be read, lacks a pass of :data:`PASSES`, or the other cannot be written.
    """
    parts = _read(source)
    buffers = _buffers(source, parts, layer)
    if blurred:
        buffers["motion"] = np.full_like(buffers["motion"], np.inf)
    image = denoise(buffers)
    if not np.isfinite(image).all():
        raise FrameError(f"{source}: the result is not finite")
    if lights:
        _denoise_lights(denoise, source, parts, layer, buffers, image)
    pixels, places = _channels(source, parts, layer, (RESULT,), "RGB")
    pixels[..., places] = image
    _write(target, parts)


def _denoise_lights(denoise, path, parts, layer, buffers, image):
    """Replace the pixels of the passes of light."""
    there = {name for spec, _ in parts for name in spec.channelnames}
    found = {name: color for name, color in LIGHTS.items() if f"{layer}.{name}.R" in there}
    if not found:
        raise FrameError(f"{path}: expected passes of light, such as Diffuse Direct, found none; render with them")
    places = {name: _channels(path, parts, layer, (name,), "RGB") for name in found}
    colors = dict.fromkeys(found, np.ones((1, 1, 3), np.float32))  # of light that is not divided
    for name, color in found.items():
        if color is not None:
            pixels, at = _channels(path, parts, layer, (color,), "RGB")
            colors[name] = pixels[..., at]
    noisy = {name: np.nan_to_num(pixels[..., at]) * colors[name] for name, (pixels, at) in places.items()}
    split = denoise.split(buffers, image, closed(buffers["color"], noisy))
    del split[REST]
    # A pass cannot hold light where its color is black: the others get it, so that the sum stays.
    held = {name: np.where(colors[name] > _DARKEST, light, 0) for name, light in split.items()}
    total, left = sum(split.values()), sum(held.values())
    scale = np.divide(total, left, out=np.ones_like(total), where=left > 0)
    for name, (pixels, at) in places.items():
        pixels[..., at] = held[name] * scale / np.maximum(colors[name], _DARKEST)


def _session(path):
    import onnxruntime  # imported here because it takes as long as a frame

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def _batch(image):
    """An image ``(H, W, C)`` as ``(1, C, H, W)``."""
    return np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32)


def _read(path):
    """Specification and pixels of each part."""
    file = oiio.ImageInput.open(str(path))
    if file is None:
        raise FrameError(f"{path}: cannot be read: {oiio.geterror()}")
    parts = []
    while file.seek_subimage(len(parts), 0):
        spec, end = oiio.ImageSpec(file.spec()), file.spec().y + file.spec().height
        step = spec.height if spec.tile_width else _ROWS
        strips = [(top, min(top + step, end)) for top in range(spec.y, end, step)]
        read = [file.read_scanlines(len(parts), 0, *strip, 0, 0, spec.nchannels, "float") for strip in strips]
        if any(strip is None for strip in read):
            raise FrameError(f"{path}: cannot be read: {file.geterror()}")
        parts.append((spec, np.concatenate(read).reshape(spec.height, spec.width, spec.nchannels)))
    file.close()
    return parts


def _channels(path, parts, layer, names, letters):
    """The pixels of the part with the first pass of a view layer that there is, and the places of its channels."""
    for name in names:
        wanted = [f"{layer}.{name}.{letter}" for letter in letters]
        for spec, pixels in parts:
            if set(wanted) <= set(spec.channelnames):
                return pixels, [spec.channelnames.index(each) for each in wanted]
    raise FrameError(f"{path}: expected the pass {names[-1]} of the view layer {layer}, found none; render with it")


def _buffers(path, parts, layer):
    found = {}
    for buffer, (names, letters) in PASSES.items():
        pixels, places = _channels(path, parts, layer, names, letters)
        found[buffer] = pixels[..., places]
    depth = found["depth"]
    found["depth"] = np.where(np.isfinite(depth) & (depth < _FARTHEST), depth, np.inf).astype(np.float32)
    found["color"] = np.nan_to_num(found["color"], nan=0, posinf=_BRIGHTEST, neginf=0).clip(0, _BRIGHTEST)
    found["albedo"] = np.nan_to_num(found["albedo"]).clip(0, 1)
    found["normal"] = np.nan_to_num(found["normal"]).clip(-1, 1)
    # Blender's y points up, and where something moves, a background has zeros, as its motion is unknown.
    motion = found["motion"] * np.float32([1, -1])
    known = np.isfinite(motion) & (np.isfinite(found["depth"]) | (motion != 0) | ~motion.any())
    found["motion"] = np.where(known, motion, np.float32(np.inf))
    return found


def _write(path, parts):
    """Write all parts atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp.exr")
    file = oiio.ImageOutput.create(str(temporary))
    try:
        if not _written(file, str(temporary), parts):
            raise FrameError(f"{path}: cannot be written: {file.geterror()}")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _written(file, name, parts):
    """Write all parts, as far as that is possible; returns whether it is."""
    specs = tuple(spec for spec, _ in parts)
    opened = file.open(name, specs if len(specs) > 1 else specs[0])
    for number, (spec, pixels) in enumerate(parts):
        opened = opened and (not number or file.open(name, spec, "AppendSubimage")) and file.write_image(pixels)
    return opened and file.close()
