"""Write files with the channel names of renderers that did not run here.

    python others.py RENDERER FOLDER

**These files were not rendered by the renderers whose names they bear.** The pixels are those of ``blender/``, which
Cycles rendered; only names, components, units and backgrounds are as those renderers' public documentation and the
readers and scripts that people published for them say. Where they say nothing, what was assumed is written beside it,
and the value where nothing is hit differs from one to the next (0, 1e10, 1e30, infinity) to cover what a reader meets.
They show that a reader copes with such names, not that it copes with such a renderer.

Tests call :func:`write`; nothing that it writes is kept in the repository.
"""

import sys
from pathlib import Path

import numpy as np
import OpenImageIO

HERE = Path(__file__).resolve().parent
FRAMES = (1, 2, 3)
# The place of the camera of `examples/blender/render.py` in its first frame, its step, and the point that it looks at.
CAMERA, STEP, TARGET = np.array((-0.6, -5.2, 1.7)), np.array((0.16, 0.05, 0.05)), np.array((0.1, 0.9, 0.95))


def write(renderer, folder, frames=FRAMES):
    """Write frames as ``renderer`` names them; they were not rendered by it.

    Args:
        renderer: a key of :data:`RENDERERS`.
        folder: where to write; it is made where it is missing.
        frames: which frames of ``blender/`` to take, 1 to 4.

    Returns:
        The paths of the files, frame by frame.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for frame in frames:
        for name, channels, attributes in RENDERERS[renderer](read(frame)):
            written.append(folder / name.format(frame=frame))
            save(written[-1], channels, attributes)
    return written


def pbrt(source):
    """The ``gbuffer`` film of pbrt-v4, coordinate system "camera" (its default): x right, y up, z into the scene.

    Positions and normals are 0 where nothing is hit. pbrt stores its matrix for column vectors, although OpenEXR says
    rows: ``worldToCamera`` here is so.
    """
    yield "frame{frame:04d}.exr", _pbrt(source, "{}.{}", str.upper), {"worldtocamera": source["world_to_camera"]}


def pbrt_2021(source):
    """The same film in pbrt-v4 before its channels were renamed: ``Px``, ``Nsx``."""
    yield "frame{frame:04d}.exr", _pbrt(source, "{}{}", str.lower), {}


def _pbrt(source, pattern, case):
    spread = variance(source["color"])
    slope = np.gradient(np.where(source["hit"], source["depth"], 0))
    return {
        **layer("", "RGB", source["color"]),
        **layer("Albedo", "RGB", source["albedo"]),
        **named(pattern, "P", case("xyz"), to_camera(source, source["position"], points=True)),
        "dzdx": slope[1],
        "dzdy": slope[0],
        **named(pattern, "N", case("xyz"), to_camera(source, source["normal"])),
        **named(pattern, "Ns", case("xyz"), to_camera(source, source["normal"])),
        "u": source["position"][..., 0] % 1,
        "v": source["position"][..., 1] % 1,
        **layer("Variance", "RGB", spread),
        **layer("RelativeVariance", "RGB", spread / np.maximum(source["color"] ** 2, 1e-4)),
    }


def arnold(source):
    """Return the layers that Arnold's noice asks for: RGBA, denoise_albedo, N, Z, variance.

    Assumed: N in world space, Z 1e30 where nothing is hit.
    """
    channels = {
        **layer("", "RGBA", with_alpha(source)),
        **layer("N", "XYZ", source["normal"]),
        "Z": np.where(source["hit"], source["depth"], 1e30),
        **layer("denoise_albedo", "RGB", source["albedo"]),
        **layer("denoise_albedo_noisy", "RGB", source["albedo"]),
        **layer("diffuse", "RGB", source["diffuse"]),
        **layer("specular", "RGB", source["color"] - source["diffuse"]),
        **layer("variance", "RGB", variance(source["color"])),
    }
    yield "beauty.{frame:04d}.exr", channels, {}


def renderman(source):
    """RenderMan's denoiser channels, lower-case components, Ci as the beauty, statistics in a file beside it.

    Assumed: normals in camera space (x right, y up, z into the scene), ``backward`` in pixels, previous - current.
    """
    channels = _renderman(source)
    yield "beauty.{frame:04d}.exr", {**layer("Ci", "rgb", source["color"]), "a": source["alpha"], **channels}, {}
    yield "beauty_variance.{frame:04d}.exr", _renderman_statistics(source), {}


def renderman_rgba(source):
    """The same in one file, written with ``asrgba``: Ci and a are R, G, B, A."""
    channels = {**layer("", "RGBA", with_alpha(source)), **_renderman(source), **_renderman_statistics(source)}
    yield "shot.{frame:04d}.exr", channels, {}


def _renderman(source):
    still = np.zeros_like(source["depth"])
    backward = np.stack([*np.moveaxis(source["motion"], -1, 0), still], -1)
    forward = np.stack([*np.moveaxis(source["to_next"], -1, 0), still], -1)
    return {
        **layer("albedo", "rgb", source["albedo"]),
        **layer("diffuse", "rgb", source["diffuse"]),
        **layer("specular", "rgb", source["color"] - source["diffuse"]),
        **layer("normal", "xyz", to_camera(source, source["normal"])),
        "zfiltered": np.where(source["hit"], source["depth"], 1e30),
        **layer("forward", "xyz", forward),
        **layer("backward", "xyz", backward),
        "sampleCount": np.ones_like(source["depth"]),
    }


def _renderman_statistics(source):
    spread = variance(source["color"])
    return {
        **layer("mse", "rgb", spread),
        **layer("albedo_var", "rgb", variance(source["albedo"])),
        **layer("albedo_mse", "rgb", variance(source["albedo"])),
        **layer("diffuse_mse", "rgb", variance(source["diffuse"])),
        **layer("specular_mse", "rgb", variance(source["color"] - source["diffuse"])),
        **layer("normal_var", "xyz", variance(source["normal"])),
        "zfiltered_var": np.zeros_like(source["depth"]),
    }


def vray(source):
    """V-Ray with its denoiser: RGBA as rendered, ``effectsResult`` denoised.

    Assumed: normals in camera space, velocity current - previous in pixels, Z infinite where nothing is hit.
    """
    channels = {
        **layer("", "RGBA", with_alpha(source)),
        "Z": np.where(source["hit"], source["depth"], np.inf),
        **layer("diffuseFilter", "RGB", source["albedo"]),
        **layer("effectsResult", "RGB", blurred(source["color"])),
        **layer("normals", "XYZ", to_camera(source, source["normal"])),
        **layer("velocity", "XYZ", np.concatenate([-source["motion"], 0 * source["depth"][..., None]], -1)),
    }
    yield "render.{frame:04d}.exr", channels, {}


def redshift(source):
    """Redshift: DiffuseFilter, BumpNormals, Z, MotionVectors, WorldPosition.

    Assumed: normals in world space, in components R, G, B; raw motion vectors in pixels with y up, current - previous;
    Z 0 where nothing is hit.
    """
    flow = np.stack([-source["motion"][..., 0], source["motion"][..., 1], 0 * source["depth"]], -1)
    channels = {
        **layer("", "RGBA", with_alpha(source)),
        "Z": np.where(source["hit"], source["depth"], 0),
        **layer("BumpNormals", "RGB", source["normal"]),
        **layer("DiffuseFilter", "RGBA", with_alpha({**source, "color": source["albedo"]})),
        **layer("MotionVectors", "RGB", flow),
        **layer("WorldPosition", "RGB", source["position"]),
    }
    yield "shot_{frame:04d}.exr", channels, {}


def octane(source):
    """Octane with its denoiser: ``Beauty`` denoised, ``Beauty_Noisy`` as rendered.

    Assumed: the names of the normals and the depth, and that normals are encoded into 0..1, as Octane shows them.
    """
    channels = {
        **layer("Beauty", "RGBA", with_alpha({**source, "color": blurred(source["color"])})),
        **layer("Beauty_Noisy", "RGBA", with_alpha(source)),
        **layer("DiffuseFilter", "RGB", source["albedo"]),
        **layer("ShadingNormal", "RGB", np.where(source["hit"][..., None], source["normal"] * 0.5 + 0.5, 0)),
        **layer("Depth", "Z", np.where(source["hit"], source["depth"], 1e10)[..., None]),
    }
    yield "octane_{frame:04d}.exr", channels, {}


def falcor(source):
    """Falcor's Mogwai: a file for each output of the graph, frames without padding.

    Assumed: world space; ``mvec`` is previous - current as a fraction of width and height, y down; linearZ 0 where
    nothing is hit.
    """
    height, width = source["depth"].shape
    one = source["hit"][..., None].astype(np.float32)
    outputs = {
        "AccumulatePass.output": layer("", "RGBA", with_alpha(source)),
        "GBufferRT.diffuseOpacity": layer("", "RGBA", np.concatenate([source["albedo"], one], -1)),
        "GBufferRT.normW": layer("", "RGBA", np.concatenate([source["normal"], 0 * one], -1)),
        "GBufferRT.posW": layer("", "RGBA", np.concatenate([source["position"], one], -1)),
        "GBufferRT.linearZ": layer("", "RG", np.stack([source["depth"] * source["hit"], 0 * source["depth"]], -1)),
        "GBufferRT.mvec": layer("", "RG", source["motion"] / np.array((width, height))),
    }
    for output, channels in outputs.items():
        yield f"Mogwai.{output}.{{frame}}.exr", channels, {}


RENDERERS = {
    writer.__name__: writer
    for writer in (pbrt, pbrt_2021, arnold, renderman, renderman_rgba, vray, redshift, octane, falcor)
}


def read(frame):
    """The buffers of a frame of ``blender/``; motion is previous - current in pixels, y down."""
    image = OpenImageIO.ImageBuf(str(HERE / "blender" / f"shot_{frame:04d}.exr"))
    names = list(image.spec().channelnames)
    pixels = np.asarray(image.get_pixels(OpenImageIO.FLOAT), dtype=np.float32)

    def take(name, components):
        return pixels[..., [names.index(f"ViewLayer.{name}.{component}") for component in components]]

    depth, vector = take("Depth", "Z")[..., 0], take("Vector", "XYZW")
    camera = CAMERA + (frame - 1) * STEP
    forward = (TARGET - camera) / np.linalg.norm(TARGET - camera)
    right = np.cross(forward, (0, 0, 1)) / np.linalg.norm(np.cross(forward, (0, 0, 1)))
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = right, np.cross(right, forward), forward
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ camera
    return {
        "color": take("Combined", "RGB"),
        "alpha": take("Combined", "A")[..., 0],
        # Cycles adds what a lamp and the sky emit, which none of these renderers does.
        "albedo": np.where((depth < 1e9)[..., None], np.minimum(take("Denoising Albedo", "RGB"), 1), 0),
        "diffuse": take("DiffCol", "RGB") * (take("DiffDir", "RGB") + take("DiffInd", "RGB")),
        "normal": take("Normal", "XYZ"),
        "position": take("Position", "XYZ"),
        "depth": depth,
        "hit": depth < 1e9,
        "motion": vector[..., :2] * (1, -1),
        "to_next": vector[..., 2:] * (-1, 1),
        "world_to_camera": world_to_camera,
    }


def to_camera(source, vectors, points=False):
    """World to camera space: x right, y up, z into the scene; 0 where nothing is hit."""
    matrix = source["world_to_camera"]
    moved = vectors @ matrix[:3, :3].T + (matrix[:3, 3] if points else 0)
    return np.where(source["hit"][..., None], moved, 0)


def with_alpha(source):
    return np.concatenate([source["color"], source["alpha"][..., None]], -1)


def blurred(image):
    """The mean over 3x3 pixels, in place of what a denoiser does."""
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    height, width = image.shape[:2]
    return sum(padded[y : y + height, x : x + width] for y in range(3) for x in range(3)) / 9


def variance(image):
    """The variance over 3x3 pixels, in place of that over samples, of which there is one."""
    return np.maximum(blurred(image**2) - blurred(image) ** 2, 0)


def layer(name, components, values):
    """Channels ``name.R`` and on; without a name ``R`` and on."""
    return named("{}.{}" if name else "{}{}", name, components, values)


def named(pattern, name, components, values):
    return {pattern.format(name, component): values[..., i] for i, component in enumerate(components)}


def save(path, channels, attributes):
    """Write float channels in their given order."""
    pixels = np.ascontiguousarray(np.stack(list(channels.values()), -1), dtype=np.float32)
    height, width, count = pixels.shape
    spec = OpenImageIO.ImageSpec(width, height, count, OpenImageIO.FLOAT)
    spec.channelnames = tuple(channels)
    spec.attribute("compression", "zip")
    for name, value in attributes.items():
        # OpenImageIO and OpenEXR keep the sixteen numbers in the order they come in.
        spec.attribute(name, "matrix", tuple(float(number) for number in np.ravel(value)))
    output = OpenImageIO.ImageOutput.create(str(path))
    if output is None or not output.open(str(path), spec) or not output.write_image(pixels) or not output.close():
        raise OSError(f"{path}: {output.geterror() if output else OpenImageIO.geterror()}")


if __name__ == "__main__":
    if len(sys.argv) != 3 or sys.argv[1] not in RENDERERS:
        sys.exit(f"usage: others.py {{{','.join(RENDERERS)}}} FOLDER")
    for written in write(sys.argv[1], sys.argv[2]):
        print(written)
