"""Denoising of multilayer EXR files by a graph in ONNX, with numpy, onnxruntime and OpenImageIO only."""

import os
from pathlib import Path

import numpy as np

try:
    from OpenImageIO import OpenImageIO as oiio  # Blender has the module in a folder of that name
except ImportError:
    import OpenImageIO as oiio

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
_DARKEST = 1e-3  # smallest color that light is divided by
_ROWS = 64  # converted at a time, in the cache of a core: in two thirds of the time
# Blender writes 1e10 where no surface is.
_FARTHEST, _BRIGHTEST = 1e9, 1e16


class FrameError(Exception):
    """A file cannot be read, lacks a pass, or cannot be written: one line."""


class Graph:
    """A graph of a step: from a frame and the state after the frame before it.

    Args:
        name: that of the file beside this one.
    """

    def __init__(self, name):
        import onnxruntime  # imported here because it takes as long as a frame

        path, options = Path(__file__).with_name(f"{name}.onnx"), onnxruntime.SessionOptions()
        options.log_severity_level = 3
        self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        self._outputs = [each.name for each in self._session.get_outputs()]

    def __call__(self, buffers, before=None):
        """The image ``(H, W, C)`` of buffers ``(H, W, C)`` by name, float32; and the state after it."""
        height, width, _ = buffers["color"].shape
        sizes = {"batch": 1, "height": height, "width": width}
        feeds, before = {}, before or {}
        for given in self._session.get_inputs():
            if given.name in buffers:
                feeds[given.name] = np.ascontiguousarray(buffers[given.name].transpose(2, 0, 1)[None], np.float32)
                continue
            shape, state = tuple(sizes.get(each, each) for each in given.shape), before.get(given.name)
            feeds[given.name] = np.zeros(shape, np.float32) if state is None or state.shape != shape else state
        image, *after = self._session.run(self._outputs, feeds)
        names = (name.removeprefix("next_") for name in self._outputs[1:])
        return image[0].transpose(1, 2, 0), dict(zip(names, after, strict=True))


class Denoiser:
    """Denoises the frames of a shot one after the other."""

    def __init__(self):
        self._features, self._model, self._light = Graph("features"), Graph("model"), None
        self._state, self._states = None, {}

    def __call__(self, buffers, lights):
        """Denoise an image ``(H, W, 3)`` and the parts of it that are lights, ``(H, W, 3)`` by name, float32.

        Args:
            buffers: ``(H, W, C)`` by name.
            lights: the noisy lights, ``(H, W, 3)`` by name.
        """
        features, _ = self._features(buffers)
        buffers = {**buffers, "albedo": features[..., :3], "normal": features[..., 3:]}
        image, self._state = self._model(buffers, self._state)
        if not lights:
            return image, {}
        self._light = self._light or Graph("light")
        buffers |= {"diffuse": image, "total": sum(lights.values())}
        denoised, before, self._states = {}, self._states, {}
        for name, light in lights.items():
            denoised[name], after = self._light({**buffers, "light": light}, before.get(name))
            # The history of the image is the same for all: only what is carried with it is a light's own.
            first = next(iter(self._states.values()), after)
            self._states[name] = {key: after[key] if "carried" in key else each for key, each in first.items()}
        return image, denoised


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
    passes = _lights(source, parts, layer) if lights else {}
    noisy = {name: _radiance(pixels[..., places] * color) for name, (pixels, places, color) in passes.items()}
    image, denoised = denoise(buffers, noisy)
    if not all(np.isfinite(each).all() for each in (image, *denoised.values())):
        raise FrameError(f"{source}: the result is not finite")
    if denoised:
        _put(passes, denoised)
    pixels, places = _channels(source, parts, layer, (RESULT,), "RGB")
    pixels[..., places] = image
    _write(target, parts)


def _lights(path, parts, layer):
    """For each pass of light the pixels of its part, the places of its channels, and the color that divides it."""
    there = {name for spec, _ in parts for name in spec.channelnames}
    found = {}
    for name, color in LIGHTS.items():
        if f"{layer}.{name}.R" in there:
            divisor = np.ones(3, np.float32)
            if color:
                pixels, places = _channels(path, parts, layer, (color,), "RGB")
                divisor = pixels[..., places]
            found[name] = (*_channels(path, parts, layer, (name,), "RGB"), divisor)
    if not found:
        raise FrameError(f"{path}: expected passes of light, such as Diffuse Direct, found none; render with them")
    return found


def _put(passes, lights):
    """Replace the pixels of the passes of light."""
    # A pass cannot hold light where its color is black: the others get it, so that the sum stays.
    held = {name: np.where(color > _DARKEST, lights[name], 0) for name, (_, _, color) in passes.items()}
    total, left = sum(lights.values()), sum(held.values())
    scale = np.divide(total, left, out=np.ones_like(total), where=left > 0)
    for name, (pixels, places, color) in passes.items():
        pixels[..., places] = held[name] * scale / np.maximum(color, _DARKEST)


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
    found["color"] = _radiance(found["color"])
    found["albedo"] = np.nan_to_num(found["albedo"]).clip(0, 1)
    found["normal"] = np.nan_to_num(found["normal"]).clip(-1, 1)
    # Blender's y points up, and where something moves, a background has zeros, as its motion is unknown.
    motion = found["motion"] * np.float32([1, -1])
    known = np.isfinite(motion) & (np.isfinite(found["depth"]) | (motion != 0) | ~motion.any())
    found["motion"] = np.where(known, motion, np.float32(np.inf))
    return found


def _radiance(pixels):
    return np.nan_to_num(pixels, nan=0, posinf=_BRIGHTEST).clip(0, _BRIGHTEST)


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
