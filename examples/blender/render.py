"""Render a small scene with Blender's Cycles into multilayer EXR files, as an artist would.

    python render.py -o shots --size 320x180 --frames 8 --samples 1 --filter none --reference-samples 256

The folder then contains ``shot_0001.exr``, ``shot_0002.exr``, ... with every pass that a denoiser can use (Combined,
Denoising Albedo, Normal and Depth, Depth, Position, Normal, Vector, the light passes), and ``reference_0001.exr``, ...
with Combined only: the same frames with many samples.

The script builds the scene: a lacquered checkered floor, a brick wall, rough steel, glass, a mirror, a visible lamp, a
sky, a moving diffuse object and a moving camera. It downloads nothing.

This script is self-contained: apart from the standard library it imports only Blender's Python module ``bpy``, which is
under the GPL (``pip install bpy==4.5.15`` or ``bpy==5.0.1``, Python 3.11; it needs no display). Blender 4.5 writes all
passes into one part of the file; Blender 5.0 writes one part per pass, unless ``--interleave`` is given.
"""

import argparse
import math
from pathlib import Path

import bpy

PARTS = [f"{kind}_{part}" for kind in ("diffuse", "glossy", "transmission") for part in ("direct", "indirect", "color")]
PASSES = {
    "data": ["z", "position", "normal", "vector"],
    "light": ["emit", "environment", *PARTS],
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder to write to")
    parser.add_argument("--name", default="shot", help="name of the files before _0001.exr")
    parser.add_argument("--size", default="320x180", help="WIDTHxHEIGHT in pixels")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--start", type=int, default=1, help="number of the first frame")
    parser.add_argument("--samples", type=int, default=1, help="samples per pixel")
    parser.add_argument(
        "--filter",
        choices=("default", "none"),
        default="default",
        help="pixel filter: Blackman-Harris of 1.5 pixels, or every sample at the centre of its pixel",
    )
    parser.add_argument("--depth-of-field", action="store_true")
    parser.add_argument("--motion-blur", action="store_true", help="Blender then writes a Vector pass of zeros")
    parser.add_argument("--transparent", action="store_true", help="make the film transparent where the sky is visible")
    parser.add_argument("--denoise", action="store_true", help="denoise Combined in Blender, and write Noisy Image too")
    parser.add_argument(
        "--passes",
        nargs="*",
        choices=("denoising", "data", "light", "samples"),
        default=("denoising", "data", "light"),
        help="groups of passes besides Combined: Denoising Albedo, Normal and Depth; Depth, Position, Normal and "
        "Vector; diffuse, glossy and transmission light with emission and environment; Debug Sample Count",
    )
    parser.add_argument("--view-layer", default="ViewLayer", help="name of the view layer")
    parser.add_argument("--stereo", action="store_true", help="two views in one file")
    parser.add_argument("--second-layer", metavar="NAME", help="add a second view layer, without the wall")
    parser.add_argument("--composite", action="store_true", help="Blender 4.5: also write the compositor's result")
    parser.add_argument("--interleave", action="store_true", help="Blender 5: one part for all passes, as before 5.0")
    parser.add_argument("--codec", default="ZIP", help="ZIP, ZIPS, PIZ, RLE, PXR24, DWAA, DWAB, NONE")
    parser.add_argument("--float", action="store_true", help="write 32 bits for every channel, not 16 for colors")
    parser.add_argument(
        "--reference-samples", type=int, default=0, help="also write references, with this many samples"
    )
    parser.add_argument("--seed", type=int, default=0, help="noise seed; every frame has independent noise")
    parser.add_argument("--threads", type=int, default=0, help="processor threads; 0 uses all")
    args = parser.parse_args()

    scene = build_scene(args.start, args.frames)
    width, height = (int(number) for number in args.size.split("x"))
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    if args.threads:
        scene.render.threads_mode, scene.render.threads = "FIXED", args.threads
    scene.render.film_transparent = args.transparent
    scene.render.use_motion_blur = args.motion_blur
    scene.camera.data.dof.use_dof = args.depth_of_field
    if args.stereo:
        scene.render.use_multiview = True
        scene.render.views_format = "STEREO_3D"

    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.use_adaptive_sampling = False
    # In Cycles the width does not apply to a box filter, so the narrow filter is a Blackman-Harris filter too.
    cycles.pixel_filter_type = "BLACKMAN_HARRIS"
    cycles.filter_width = 0.01 if args.filter == "none" else 1.5

    layer = scene.view_layers[0]
    layer.name = args.view_layer
    layers = [layer]
    if args.second_layer:
        layers.append(scene.view_layers.new(args.second_layer))
        hide_wall(scene, layers[1])
    if args.composite:
        composite(scene)
    settings = scene.render.image_settings
    if bpy.app.version >= (5, 0):
        settings.media_type = "MULTI_LAYER_IMAGE"
        settings.use_exr_interleave = args.interleave
    settings.file_format = "OPEN_EXR_MULTILAYER"
    settings.exr_codec = args.codec
    settings.color_depth = "32" if args.float else "16"
    if args.stereo:
        settings.views_format = "MULTIVIEW"

    args.output.mkdir(parents=True, exist_ok=True)
    for layer in layers:
        choose_passes(layer, args.passes)
    cycles.use_denoising = args.denoise
    if args.denoise:
        cycles.denoiser = "OPENIMAGEDENOISE"
    render(scene, args.output, args.name, args.samples, args.seed)
    if args.reference_samples:
        for layer in layers:
            choose_passes(layer, ())
        cycles.use_denoising = False
        # Use another seed: the noise of the reference must be independent of that of the frame.
        render(scene, args.output, "reference", args.reference_samples, args.seed + 1_000_000)


def choose_passes(layer, groups):
    """Enable the passes of these groups only."""
    for group, names in PASSES.items():
        for name in names:
            setattr(layer, f"use_pass_{name}", group in groups)
    layer.cycles.denoising_store_passes = "denoising" in groups
    layer.cycles.pass_debug_sample_count = "samples" in groups


def hide_wall(scene, layer):
    """Exclude the wall from a view layer, by moving it to a separate collection."""
    collection = bpy.data.collections.new("Behind")
    scene.collection.children.link(collection)
    wall = bpy.data.objects["Wall"]
    for owner in wall.users_collection:
        owner.objects.unlink(wall)
    collection.objects.link(wall)
    layer.layer_collection.children[collection.name].exclude = True


def composite(scene):
    """Let the compositor darken the image of the first view layer a little."""
    scene.use_nodes = True
    tree = scene.node_tree
    tree.nodes.clear()
    source = tree.nodes.new("CompositorNodeRLayers")
    darker = tree.nodes.new("CompositorNodeExposure")
    darker.inputs["Exposure"].default_value = -0.5
    target = tree.nodes.new("CompositorNodeComposite")
    tree.links.new(source.outputs["Image"], darker.inputs["Image"])
    tree.links.new(darker.outputs["Image"], target.inputs["Image"])


def render(scene, folder, name, samples, seed):
    """Render every frame of the scene to ``folder/name_0001.exr``, ``folder/name_0002.exr``, ..."""
    scene.cycles.samples = samples
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        scene.cycles.seed = seed + frame
        scene.render.filepath = str((folder / f"{name}_{frame:04d}.exr").resolve())
        bpy.ops.render.render(write_still=True)


def build_scene(start, frames):
    """Build the scene, with its camera and its moving object animated from frame ``start`` on."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.frame_start, scene.frame_end = start, start + frames - 1
    scene.world = sky()

    plane("Floor", (0, 0, 0), (0, 0, 0), 12, checkered_lacquer())
    plane("Wall", (0, 3.5, 1.4), (math.pi / 2, 0, 0), (9, 2.8), bricks())
    plane("Mirror", (-2.6, 1.6, 1.0), (math.pi / 2, 0, math.radians(50)), (2.0, 1.8), metal("Mirror", 0.9, 0.0))
    ball("Steel", (-0.9, 0.9, 0.7), 0.7, metal("Steel", 0.62, 0.35))
    ball("Glass", (0.75, -0.4, 0.5), 0.5, glass())
    ball("Lamp", (1.9, 1.9, 2.0), 0.3, lamp())
    bpy.ops.mesh.primitive_monkey_add(size=1.2, location=(2.1, 0.4, 0.62), rotation=(0, 0, math.radians(-25)))
    mover = finish("Mover", matt("Clay", (0.72, 0.22, 0.1)))
    mover.modifiers.new("Smooth", "SUBSURF").render_levels = 2

    camera_data = bpy.data.cameras.new("Camera")
    camera = bpy.data.objects.new("Camera", camera_data)
    scene.collection.objects.link(camera)
    scene.camera = camera
    target = bpy.data.objects.new("Target", None)
    target.location = (0.1, 0.9, 0.95)
    scene.collection.objects.link(target)
    aim = camera.constraints.new("TRACK_TO")
    aim.target, aim.track_axis, aim.up_axis = target, "TRACK_NEGATIVE_Z", "UP_Y"
    camera_data.lens = 30
    camera_data.dof.focus_distance = 5.0
    camera_data.dof.aperture_fstop = 0.3

    # For the Vector pass Cycles needs the previous and the next frame, so the animation covers one more on either side.
    for frame in range(start - 1, start + frames + 1):
        step = frame - start
        camera.location = (-0.6 + 0.16 * step, -5.2 + 0.05 * step, 1.7 + 0.05 * step)
        camera.keyframe_insert("location", frame=frame)
        mover.location = (2.1 - 0.12 * step, 0.4 + 0.05 * step, 0.62)
        mover.keyframe_insert("location", frame=frame)
    return scene


def plane(name, location, rotation, size, material):
    bpy.ops.mesh.primitive_plane_add(size=1, location=location, rotation=rotation)
    width, height = size if isinstance(size, tuple) else (size, size)
    bpy.context.object.scale = (width, height, 1)
    return finish(name, material)


def ball(name, location, radius, material):
    bpy.ops.mesh.primitive_uv_sphere_add(radius=radius, location=location, segments=64, ring_count=32)
    return finish(name, material)


def finish(name, material):
    """Name the active object, smooth it and assign its material."""
    thing = bpy.context.object
    thing.name = name
    thing.data.materials.append(material)
    thing.data.polygons.foreach_set("use_smooth", [True] * len(thing.data.polygons))
    return thing


def surface(name, **inputs):
    """A material of one Principled BSDF, its node tree, and the BSDF's node."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    for key, value in inputs.items():
        shader.inputs[key.replace("_", " ")].default_value = value
    return material, material.node_tree, shader


def matt(name, color):
    return surface(name, Base_Color=(*color, 1), Roughness=1.0)[0]


def metal(name, color, roughness):
    return surface(name, Base_Color=(color, color, color * 1.02, 1), Metallic=1.0, Roughness=roughness)[0]


def glass():
    return surface("Glass", Base_Color=(0.95, 1.0, 0.97, 1), Roughness=0.0, IOR=1.5, Transmission_Weight=1.0)[0]


def lamp():
    material, _, shader = surface("Lamp")
    shader.inputs["Emission Color"].default_value = (1.0, 0.72, 0.4, 1)
    shader.inputs["Emission Strength"].default_value = 25.0
    return material


def checkered_lacquer():
    material, tree, shader = surface("Lacquer", Roughness=0.6, Coat_Weight=1.0, Coat_Roughness=0.03)
    checks = texture(tree, "ShaderNodeTexChecker", Scale=14.0)
    checks.inputs["Color1"].default_value = (0.55, 0.45, 0.32, 1)
    checks.inputs["Color2"].default_value = (0.08, 0.1, 0.14, 1)
    stains = texture(tree, "ShaderNodeTexNoise", Scale=30.0)
    mix = tree.nodes.new("ShaderNodeMixRGB")
    mix.blend_type, mix.inputs["Fac"].default_value = "MULTIPLY", 0.5
    tree.links.new(checks.outputs["Color"], mix.inputs["Color1"])
    tree.links.new(stains.outputs["Fac"], mix.inputs["Color2"])
    tree.links.new(mix.outputs["Color"], shader.inputs["Base Color"])
    return material


def bricks():
    material, tree, shader = surface("Bricks", Roughness=1.0)
    wall = texture(tree, "ShaderNodeTexBrick", Scale=6.0)
    wall.inputs["Color1"].default_value = (0.5, 0.2, 0.12, 1)
    wall.inputs["Color2"].default_value = (0.35, 0.12, 0.08, 1)
    wall.inputs["Mortar"].default_value = (0.75, 0.72, 0.66, 1)
    tree.links.new(wall.outputs["Color"], shader.inputs["Base Color"])
    return material


def texture(tree, kind, **inputs):
    """A texture node in the object's generated coordinates (0..1)."""
    node = tree.nodes.new(kind)
    where = tree.nodes.new("ShaderNodeTexCoord")
    tree.links.new(where.outputs["Generated"], node.inputs["Vector"])
    for key, value in inputs.items():
        node.inputs[key].default_value = value
    return node


def sky():
    world = bpy.data.worlds.new("Sky")
    world.use_nodes = True
    tree = world.node_tree
    node = tree.nodes.new("ShaderNodeTexSky")
    # Blender 5.0 renamed Nishita's sky model.
    node.sky_type = "NISHITA" if bpy.app.version < (5, 0) else "SINGLE_SCATTERING"
    node.sun_elevation, node.sun_rotation = math.radians(28), math.radians(215)
    node.sun_size = math.radians(3)
    node.sun_intensity = 0.4
    tree.links.new(node.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    tree.nodes["Background"].inputs["Strength"].default_value = 0.07
    return world


if __name__ == "__main__":
    main()
