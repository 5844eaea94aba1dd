"""Write files with the channel names of renderers that did not run here.

    python others.py RENDERER FOLDER

**These files were not rendered by the renderers whose names they bear.** The pixels are those of ``blender/``, which
Cycles rendered; only names, components, units and backgrounds are as those renderers' public documentation and the
readers and scripts that people published for them say. Where they say nothing, what was assumed is written beside it,
and the value where nothing is hit differs from one to the next (0, 1e10, 1e30, infinity) to cover what a reader meets.
They show that a reader copes with such names, not that it copes with such a renderer.

Tests call :func:`write`; nothing that it writes is kept in the repository.
"""

import re
import sys
from pathlib import Path

import numpy as np
import OpenImageIO

HERE = Path(__file__).resolve().parent
FRAMES = (1, 2, 3)
# The place of the camera of `examples/blender/render.py` in its first frame, its step, and the point that it looks at.
CAMERA, STEP, TARGET = np.array((-0.6, -5.2, 1.7)), np.array((0.16, 0.05, 0.05)), np.array((0.1, 0.9, 0.95))


# For each renderer its files, and in each the layers: names of channels, and the image of :func:`images` in them. After
# a point or a colon, each letter is a channel, with a point before it or without; other names are of single channels.
STATISTICS = """
    mse.rgb color_variance    albedo_var.rgb albedo_variance    albedo_mse.rgb albedo_variance
    diffuse_mse.rgb diffuse_variance    specular_mse.rgb specular_variance    normal_var.xyz normal_variance
    zfiltered_var zeros
"""
RENDERMAN = """
    albedo.rgb albedo    diffuse.rgb diffuse    specular.rgb specular    normal.xyz camera_normal
    zfiltered depth_1e30    forward.xyz forward    backward.xyz backward    sampleCount ones
"""
PBRT = """
    :RGB color    Albedo.RGB albedo    {P} camera_position    dzdx slope_x    dzdy slope_y    {N} camera_normal
    {Ns} camera_normal    u u    v v    Variance.RGB color_variance    RelativeVariance.RGB relative_variance
"""
RENDERERS = {
    # The ``gbuffer`` film of pbrt-v4, coordinate system "camera" (its default): x right, y up, z into the scene.
    # Positions and normals are 0 where nothing is hit. pbrt stores its matrix for column vectors, although OpenEXR says
    # rows: ``worldToCamera`` here is so.
    "pbrt": {"frame{frame:04d}.exr": PBRT.format(P="P.XYZ", N="N.XYZ", Ns="Ns.XYZ")},
    # The same film in pbrt-v4 before its channels were renamed: ``Px``, ``Nsx``.
    "pbrt_2021": {"frame{frame:04d}.exr": PBRT.format(P="P:xyz", N="N:xyz", Ns="Ns:xyz")},
    # The layers that Arnold's noice asks for: RGBA, denoise_albedo, N, Z, variance. Assumed: N in world space, Z 1e30
    # where nothing is hit.
    "arnold": {
        "beauty.{frame:04d}.exr": """
            :RGBA rgba    N.XYZ normal    Z depth_1e30    denoise_albedo.RGB albedo    denoise_albedo_noisy.RGB albedo
            diffuse.RGB diffuse    specular.RGB specular    variance.RGB color_variance
        """
    },
    # RenderMan's denoiser channels, lower-case components, Ci as the beauty, statistics in a file beside it. Assumed:
    # normals in camera space (x right, y up, z into the scene), ``backward`` in pixels, previous - current.
    "renderman": {
        "beauty.{frame:04d}.exr": f"Ci.rgb color    a alpha {RENDERMAN}",
        "beauty_variance.{frame:04d}.exr": STATISTICS,
    },
    # The same in one file, written with ``asrgba``: Ci and a are R, G, B, A.
    "renderman_rgba": {"shot.{frame:04d}.exr": f":RGBA rgba {RENDERMAN} {STATISTICS}"},
    # V-Ray with its denoiser: RGBA as rendered, ``effectsResult`` denoised. Assumed: normals in camera space, velocity
    # current - previous in pixels, Z infinite where nothing is hit.
    "vray": {
        "render.{frame:04d}.exr": """
            :RGBA rgba    Z depth_inf    diffuseFilter.RGB albedo    effectsResult.RGB blurred
            normals.XYZ camera_normal    velocity.XYZ velocity
        """
    },
    # Redshift: DiffuseFilter, BumpNormals, Z, MotionVectors, WorldPosition. Assumed: normals in world space, in
    # components R, G, B; raw motion vectors in pixels with y up, current - previous; Z 0 where nothing is hit.
    "redshift": {
        "shot_{frame:04d}.exr": """
            :RGBA rgba    Z depth_0    BumpNormals.RGB normal    DiffuseFilter.RGBA albedo_alpha
            MotionVectors.RGB flow    WorldPosition.RGB position
        """
    },
    # Octane with its denoiser: ``Beauty`` denoised, ``Beauty_Noisy`` as rendered. Assumed: the names of the normals and
    # the depth, and that normals are encoded into 0..1, as Octane shows them.
    "octane": {
        "octane_{frame:04d}.exr": """
            Beauty.RGBA blurred_alpha    Beauty_Noisy.RGBA rgba    DiffuseFilter.RGB albedo
            ShadingNormal.RGB encoded_normal    Depth.Z depth_1e10
        """
    },
    # Falcor's Mogwai: a file for each output of the graph, frames without padding. Assumed: world space; ``mvec`` is
    # previous - current as a fraction of width and height, y down; linearZ 0 where nothing is hit.
    "falcor": {
        f"Mogwai.{output}.{{frame}}.exr": layer
        for output, layer in {
            "AccumulatePass.output": ":RGBA rgba",
            "GBufferRT.diffuseOpacity": ":RGBA albedo_one",
            "GBufferRT.normW": ":RGBA normal_zero",
            "GBufferRT.posW": ":RGBA position_one",
            "GBufferRT.linearZ": ":RG linear_depth",
            "GBufferRT.mvec": ":RG motion_fraction",
        }.items()
    },
}


def write(renderer, folder, frames=FRAMES):
    """Write frames, of 1 to 4, as ``renderer`` names them, and return their paths; it did not render them."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for frame in frames:
        source = read(frame)
        attributes = {"worldtocamera": source["world_to_camera"]} if renderer == "pbrt" else {}
        for name, layers in RENDERERS[renderer].items():
            written.append(folder / name.format(frame=frame))
            save(written[-1], channels_of(layers, images(source)), attributes)
    return written


def channels_of(layers, pixels):
    channels, words = {}, iter(layers.split())
    for layer, image in zip(words, words, strict=True):
        name, mark, letters = re.fullmatch(r"(.*?)(?:([.:])(\w+))?", layer).groups()
        planes = np.atleast_3d(pixels[image])
        for i, letter in enumerate(letters or [""]):
            channels[f"{name}{(mark or '').strip(':')}{letter}"] = planes[..., i]
    return channels


def images(source):
    hit, one = source["hit"], source["hit"][..., None].astype(np.float32)
    depth, motion, color = source["depth"], source["motion"], source["color"]
    nothing, light = 0 * depth[..., None], source["color"] - source["diffuse"]
    varied = {name: source[name] for name in ("color", "albedo", "diffuse", "normal")} | {"specular": light}
    slope_y, slope_x = np.gradient(np.where(hit, depth, 0))
    return {
        **source,
        **{f"{name}_variance": variance(image) for name, image in varied.items()},
        **{f"depth_{far}": np.where(hit, depth, float(far)) for far in ("0", "1e10", "1e30", "inf")},
        "specular": light,
        "blurred": blurred(color),
        "rgba": joined(color, source["alpha"]),
        "blurred_alpha": joined(blurred(color), source["alpha"]),
        "albedo_alpha": joined(source["albedo"], source["alpha"]),
        "relative_variance": variance(color) / np.maximum(color**2, 1e-4),
        "camera_normal": to_camera(source, source["normal"]),
        "camera_position": to_camera(source, source["position"], points=True),
        "encoded_normal": np.where(hit[..., None], source["normal"] * 0.5 + 0.5, 0),
        "zeros": np.zeros_like(depth),
        "ones": np.ones_like(depth),
        "slope_x": slope_x,
        "slope_y": slope_y,
        "u": source["position"][..., 0] % 1,
        "v": source["position"][..., 1] % 1,
        "backward": joined(motion, nothing),
        "forward": joined(source["to_next"], nothing),
        "velocity": joined(-motion, nothing),
        "flow": joined(motion * (-1, 1), nothing),
        "albedo_one": joined(source["albedo"], one),
        "normal_zero": joined(source["normal"], 0 * one),
        "position_one": joined(source["position"], one),
        "linear_depth": joined((depth * hit)[..., None], 0 * one),
        "motion_fraction": motion / depth.shape[::-1],
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


def joined(image, channel):
    return np.concatenate([image, channel.reshape(*image.shape[:2], 1)], -1)


def blurred(image):
    """The mean over 3x3 pixels, in place of what a denoiser does."""
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    height, width = image.shape[:2]
    return sum(padded[y : y + height, x : x + width] for y in range(3) for x in range(3)) / 9


def variance(image):
    """The variance over 3x3 pixels, in place of that over samples, of which there is one."""
    return np.maximum(blurred(image**2) - blurred(image) ** 2, 0)


def save(path, channels, attributes):
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
