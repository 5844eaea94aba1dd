"""Scenes of the suite for Blender's Cycles, written as multilayer EXR files with every pass.

    python blender_scenes.py job.json

This script is run by itself. It imports Blender's Python module ``bpy``, which is under the GPL (``pip install
bpy==4.5.15``, Python 3.11; no display is needed), and otherwise only the standard library. The job names the scene, its
settings and the requested images, see :func:`main`; :mod:`mcdenoise.suite.rendering` writes the job.

``gallery``: lacquered planks, a brick wall, brushed steel, glass, a mirror, a lamp, a page of marks, thin rods, a
    moving
head. ``garden``: outdoors under the sun and an HDR sky, with grass, a fence, lacquer and a glass ball. ``attic``:
diffuse surfaces only, in a room lit through a window.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import random
import sys
from typing import Any

bpy: Any
try:
    bpy = importlib.import_module("bpy")
except ImportError:  # The script is also imported without Blender.
    bpy = None

PASSES: tuple[str, ...] = ("z", "position", "normal", "vector", "emit", "environment")
PASSES += tuple(f"{kind}_{part}" for kind in ("diffuse", "glossy") for part in ("direct", "indirect", "color"))
Color = tuple[float, float, float]


def main() -> None:
    """Read the job, and render its images.

    It has ``scene``, ``size``, ``frames``, ``filter`` (``"default"`` or ``"centre"``), ``lens``, ``blur``, ``threads``,
    and ``images``: a list of ``frame``, ``samples``, ``seed``, ``passes`` and ``out``. Files are renamed when complete.
    """
    with open(sys.argv[1], encoding="utf-8") as file:
        job = json.load(file)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    {"gallery": gallery, "garden": garden, "attic": attic}[job["scene"]](job["frames"])
    set_up(scene, job)
    for image in job["images"]:
        layer = scene.view_layers[0]
        for name in PASSES:
            setattr(layer, f"use_pass_{name}", image["passes"])
        layer.cycles.denoising_store_passes = image["passes"]
        scene.cycles.samples, scene.cycles.seed = image["samples"], image["seed"]
        scene.frame_set(image["frame"])
        unfinished = f"{image['out']}.{os.getpid()}.exr"
        scene.render.filepath = unfinished
        bpy.ops.render.render(write_still=True)
        os.replace(unfinished, image["out"])


def set_up(scene: Any, job: dict[str, Any]) -> None:
    """Render settings, independent of the scene."""
    scene.render.engine = "CYCLES"
    scene.frame_start, scene.frame_end = 0, job["frames"] - 1
    scene.render.resolution_x, scene.render.resolution_y = job["size"]
    scene.render.resolution_percentage = 100
    if job["threads"]:
        scene.render.threads_mode, scene.render.threads = "FIXED", job["threads"]
    scene.render.use_motion_blur = job["blur"]
    scene.camera.data.dof.use_dof = job["lens"]
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    # A box filter in Cycles is always one pixel wide, so the narrow filter has the default type.
    cycles.pixel_filter_type = "BLACKMAN_HARRIS"
    cycles.filter_width = 0.01 if job["filter"] == "centre" else 1.5
    settings = scene.render.image_settings
    if bpy.app.version >= (5, 0):
        settings.media_type = "MULTI_LAYER_IMAGE"
        settings.use_exr_interleave = True
    settings.file_format = "OPEN_EXR_MULTILAYER"
    settings.exr_codec, settings.color_depth = "ZIP", "32"


def gallery(frames: int) -> None:
    """Shiny surfaces, indoors with some light from the sky."""
    sky(24, 160, 0.05)
    plane("Floor", (0, 0, 0), (0, 0, 0), (12, 12), planks())
    plane("Wall", (0, 3.2, 1.5), (math.pi / 2, 0, 0), (9, 3), bricks())
    plane("Mirror", (2.5, 1.9, 1.1), (math.pi / 2, 0, math.radians(-48)), (1.8, 1.9), metal("Mirror", 0.92, 0.0))
    plane("Page", (-0.2, 3.18, 1.75), (math.pi / 2, 0, 0), (1.1, 1.3), marks())
    ball("Steel", (0.95, 0.7, 0.6), 0.6, metal("Steel", 0.6, 0.22))
    ball("Gold", (-2.35, 1.1, 0.45), 0.45, metal("Gold", 0.8, 0.08, (1.0, 0.72, 0.3)))
    ball("Glass", (-0.55, -0.55, 0.45), 0.45, glass((0.95, 1.0, 0.97)))
    cylinder("Bottle", (0.35, -0.75, 0.4), 0.16, 0.8, glass((0.5, 0.85, 0.45)))
    cylinder("Vase", (1.75, -0.35, 0.32), 0.22, 0.64, coat("Lacquer", (0.25, 0.02, 0.03)))
    ball("Lamp", (-2.2, 2.0, 2.1), 0.22, lamp(38.0, (1.0, 0.74, 0.42)))
    plane("Panel", (2.9, -2.6, 2.8), (math.radians(-50), math.radians(20), 0), (1.0, 1.6), lamp(9.0, (0.8, 0.9, 1.0)))
    plane("Block", (-1.45, 0.05, 0.31), (0, 0, math.radians(24)), (0.5, 0.5), matt("Chalk", (0.7, 0.68, 0.62)), 0.62)
    for index in range(9):
        dark = matt("Thread", (0.02, 0.02, 0.02)) if index % 2 else metal("Wire", 0.7, 0.15)
        cylinder("Rod", (-1.0 + 0.17 * index, 2.2 + 0.1 * (index % 3), 1.5), 0.0025 * (1 + index % 4), 3.0, dark)
    bpy.ops.mesh.primitive_monkey_add(size=1.05, location=(-1.9, -0.2, 0.56), rotation=(0, 0, math.radians(20)))
    head = finish("Head", matt("Clay", (0.18, 0.4, 0.62)))
    head.modifiers.new("Smooth", "SUBSURF").render_levels = 2
    path(head, frames, lambda step: (-1.9 + 0.13 * step, -0.2 - 0.03 * step, 0.56))
    camera(frames, 30, lambda step: (0.5 - 0.12 * step, -5.0 + 0.06 * step, 1.55 + 0.03 * step), (0.0, 0.9, 0.95))


def garden(frames: int) -> None:
    """Outdoors: a bright sun, sharp shadows, thin objects."""
    sky(34, 130, 0.09)
    rng = random.Random(5)
    plane("Ground", (0, 0, 0), (0, 0, 0), (40, 40), soil())
    plane("Wall", (-2.2, 4.2, 1.2), (math.pi / 2, 0, math.radians(12)), (4.5, 2.4), bricks())
    vertices: list[Color] = []
    faces: list[tuple[int, int, int]] = []
    for _ in range(9000):
        x, y = rng.uniform(-4.5, 4.5), rng.uniform(-3.2, 4.5)
        angle, height, lean = rng.uniform(0, math.pi), rng.uniform(0.08, 0.3), rng.uniform(-0.1, 0.1)
        across = (0.012 * math.cos(angle), 0.012 * math.sin(angle))
        first = len(vertices)
        vertices += [(x - across[0], y - across[1], 0), (x + across[0], y + across[1], 0), (x + lean, y + lean, height)]
        faces.append((first, first + 1, first + 2))
    mesh = bpy.data.meshes.new("Grass")
    mesh.from_pydata(vertices, [], faces)
    mesh.materials.append(matt("Grass", (0.09, 0.22, 0.04)))
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("Grass", mesh))
    for index in range(26):
        board = matt("Board", (0.5 + 0.3 * rng.random(), 0.42, 0.3))
        plane("Fence", (0.4 + 0.135 * index, 3.4, 0.7), (0, 0, 0), (0.125, 0.04), board, 1.4)
    ball("Lacquer", (1.1, 0.6, 0.75), 0.75, coat("Red", (0.5, 0.02, 0.02)))
    ball("Glass", (-0.6, -1.0, 0.4), 0.4, glass((1, 1, 1)))
    ball("Chrome", (-1.8, 0.5, 0.55), 0.55, metal("Chrome", 0.75, 0.04))
    cylinder("Post", (0.15, -0.2, 1.1), 0.03, 2.2, matt("Post", (0.75, 0.73, 0.7)))
    bpy.ops.mesh.primitive_monkey_add(size=1.0, location=(2.6, -0.2, 0.6), rotation=(0, 0, math.radians(-20)))
    head = finish("Head", coat("Blue", (0.02, 0.08, 0.35)))
    head.modifiers.new("Smooth", "SUBSURF").render_levels = 2
    path(head, frames, lambda step: (2.6 - 0.12 * step, -0.2, 0.6))
    camera(frames, 32, lambda step: (-0.8 + 0.14 * step, -5.6, 1.5), (0.1, 0.8, 0.75))


def attic(frames: int) -> None:
    """A closed room of diffuse surfaces; most of them receive the window's light after several bounces."""
    sky(30, 60, 0.16)
    plaster = matt("Plaster", (0.72, 0.68, 0.6))
    plane("Floor", (0, 0, 0), (0, 0, 0), (6, 6), boards())
    plane("Ceiling", (0, 0, 2.6), (math.pi, 0, 0), (6, 6), plaster)
    plane("Back", (0, 3, 1.3), (math.pi / 2, 0, 0), (6, 2.6), bricks())
    plane("Front", (0, -3, 1.3), (math.pi / 2, 0, 0), (6, 2.6), plaster)
    plane("Left", (-3, 0, 1.3), (0, math.pi / 2, 0), (2.6, 6), matt("Green", (0.25, 0.42, 0.28)))
    walls: list[tuple[str, Color, tuple[float, float]]] = [
        ("Below", (3, 0, 0.4), (0.8, 6)),
        ("Above", (3, 0, 2.35), (0.5, 6)),
        ("Before", (3, -1.9, 1.45), (1.3, 2.2)),
        ("Behind", (3, 2.1, 1.45), (1.3, 1.8)),
    ]
    for name, place, size in walls:
        plane(name, place, (0, math.pi / 2, 0), size, plaster)
    plane("Panel", (1.2, -0.9, 2.3), (math.pi, 0, 0), (0.5, 1.2), lamp(11.0, (1.0, 0.88, 0.72)))
    ball("Bulb", (-2.2, 1.6, 1.7), 0.09, lamp(40.0, (1.0, 0.66, 0.32)))
    rng = random.Random(2)
    for index in range(14):
        side = rng.uniform(0.25, 0.7)
        where = (rng.uniform(-2.6, 1.6), rng.uniform(-0.2, 2.4), side / 2)
        colored = matt("Box", (rng.uniform(0.1, 0.8), rng.uniform(0.1, 0.7), rng.uniform(0.1, 0.6)))
        turned = (0, 0, rng.uniform(0, 1.5))
        plane("Box", where, turned, (side, side), checks() if index % 4 == 0 else colored, side)
    for index in range(5):
        beam = matt("Beam", (0.16, 0.1, 0.06))
        plane("Beam", (-2.4 + 1.2 * index, 0, 2.45), (0, 0, 0), (0.14, 6), beam, 0.2)
    cylinder("Pillar", (-0.5, -1.3, 1.3), 0.09, 2.6, matt("Wood", (0.35, 0.2, 0.1)))
    bpy.ops.mesh.primitive_monkey_add(size=0.9, location=(0.6, -0.6, 0.5), rotation=(0, 0, math.radians(-15)))
    head = finish("Head", matt("Clay", (0.72, 0.3, 0.15)))
    path(head, frames, lambda step: (0.6 - 0.1 * step, -0.6, 0.5))
    camera(frames, 24, lambda step: (-0.3 + 0.08 * step, -2.85, 1.35), (0.0, 0.9, 0.8))


def camera(frames: int, lens: float, place: Any, target: Color) -> None:
    """A camera that moves on a path and looks at a fixed point."""
    data = bpy.data.cameras.new("Camera")
    thing = bpy.data.objects.new("Camera", data)
    scene = bpy.context.scene
    scene.collection.objects.link(thing)
    scene.camera = thing
    focus = bpy.data.objects.new("Target", None)
    focus.location = target
    scene.collection.objects.link(focus)
    aim = thing.constraints.new("TRACK_TO")
    aim.target, aim.track_axis, aim.up_axis = focus, "TRACK_NEGATIVE_Z", "UP_Y"
    data.lens, data.clip_end = lens, 1000
    data.dof.focus_distance, data.dof.aperture_fstop = 5.2, 0.35
    path(thing, frames, place)


def path(thing: Any, frames: int, place: Any) -> None:
    """Keyframes, from one before the first frame to one after the last, which the Vector pass needs."""
    bpy.context.preferences.edit.keyframe_new_interpolation_type = "LINEAR"
    for step in range(-1, frames + 1):
        thing.location = place(step)
        thing.keyframe_insert("location", frame=step)


def plane(
    name: str, where: Color, turned: Color, size: tuple[float, float], material: Any, height: float | None = None
) -> None:
    """A rectangle, or a box if a height is given."""
    make = bpy.ops.mesh.primitive_plane_add if height is None else bpy.ops.mesh.primitive_cube_add
    make(size=1, location=where, rotation=turned)
    bpy.context.object.scale = (*size, 1 if height is None else height)
    finish(name, material, smooth=False)


def ball(name: str, where: Color, radius: float, material: Any) -> None:
    """A sphere."""
    bpy.ops.mesh.primitive_uv_sphere_add(radius=radius, location=where, segments=64, ring_count=32)
    finish(name, material)


def cylinder(name: str, where: Color, radius: float, height: float, material: Any) -> None:
    """An upright cylinder."""
    bpy.ops.mesh.primitive_cylinder_add(radius=radius, depth=height, location=where, vertices=48)
    finish(name, material, smooth=False)


def finish(name: str, material: Any, smooth: bool = True) -> Any:
    """Name the object that was just created, and assign its material."""
    thing = bpy.context.object
    thing.name = name
    thing.data.materials.append(material)
    thing.data.polygons.foreach_set("use_smooth", [smooth] * len(thing.data.polygons))
    return thing


def surface(name: str, **inputs: Any) -> tuple[Any, Any, Any]:
    """A material with one Principled BSDF; also returns its node tree and the node."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    for key, value in inputs.items():
        shader.inputs[key.replace("_", " ")].default_value = value
    return material, material.node_tree, shader


def matt(name: str, color: Color) -> Any:
    """A diffuse surface without gloss."""
    return surface(name, Base_Color=(*color, 1), Roughness=1.0, Specular_IOR_Level=0.0)[0]


def metal(name: str, value: float, roughness: float, color: Color = (1.0, 1.0, 1.02)) -> Any:
    """A mirror, or a rough metal."""
    shade = tuple(value * channel for channel in color)
    return surface(name, Base_Color=(*shade, 1), Metallic=1.0, Roughness=roughness)[0]


def glass(color: Color) -> Any:
    """Solid glass."""
    return surface("Glass", Base_Color=(*color, 1), Roughness=0.0, IOR=1.5, Transmission_Weight=1.0)[0]


def coat(name: str, color: Color) -> Any:
    """A dark color under clear lacquer."""
    return surface(name, Base_Color=(*color, 1), Roughness=0.7, Coat_Weight=1.0, Coat_Roughness=0.02)[0]


def lamp(strength: float, color: Color) -> Any:
    """An emitting surface."""
    material, _, shader = surface("Lamp")
    shader.inputs["Emission Color"].default_value = (*color, 1)
    shader.inputs["Emission Strength"].default_value = strength
    return material


def patterned(name: str, kind: str, low: Color, high: Color, output: str, scale: float, **inputs: Any) -> Any:
    """A surface whose color follows a procedural texture between two colors."""
    material, tree, shader = surface(name, **inputs)
    node = tree.nodes.new(kind)
    node.inputs["Scale"].default_value = scale
    where = tree.nodes.new("ShaderNodeTexCoord")
    tree.links.new(where.outputs["Generated"], node.inputs["Vector"])
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color, ramp.color_ramp.elements[1].color = (*low, 1), (*high, 1)
    tree.links.new(node.outputs[output], ramp.inputs["Fac"])
    tree.links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
    return material, node, ramp


def planks() -> Any:
    """Dark wood with a strong grain under lacquer."""
    material, node, _ = patterned(
        "Planks", "ShaderNodeTexWave", (0.02, 0.01, 0.006), (0.2, 0.1, 0.05), "Fac", 9.0, Roughness=0.5, Coat_Weight=1.0
    )
    material.node_tree.nodes["Principled BSDF"].inputs["Coat Roughness"].default_value = 0.05
    node.inputs["Distortion"].default_value, node.inputs["Detail"].default_value = 6.0, 6.0
    return material


def boards() -> Any:
    """Matt wood."""
    material, node, _ = patterned(
        "Boards", "ShaderNodeTexWave", (0.2, 0.12, 0.07), (0.5, 0.34, 0.2), "Fac", 14.0, Roughness=1.0
    )
    node.inputs["Distortion"].default_value = 3.0
    return material


def marks() -> Any:
    """A page with fine black marks on white."""
    _, node, ramp = made = patterned(
        "Marks", "ShaderNodeTexVoronoi", (0.02, 0.02, 0.02), (0.85, 0.85, 0.82), "Distance", 34.0, Roughness=1.0
    )
    node.distance = "MANHATTAN"
    ramp.color_ramp.interpolation = "CONSTANT"
    ramp.color_ramp.elements[1].position = 0.42
    return made[0]


def soil() -> Any:
    """Soil in many shades."""
    return patterned("Soil", "ShaderNodeTexNoise", (0.05, 0.03, 0.02), (0.4, 0.3, 0.2), "Fac", 60.0, Roughness=1.0)[0]


def checks() -> Any:
    """A checkerboard."""
    return patterned("Checks", "ShaderNodeTexChecker", (0.06, 0.07, 0.1), (0.75, 0.7, 0.6), "Fac", 8.0)[0]


def bricks() -> Any:
    """A brick wall with bright mortar."""
    material, tree, shader = surface("Bricks", Roughness=1.0, Specular_IOR_Level=0.0)
    wall = tree.nodes.new("ShaderNodeTexBrick")
    wall.inputs["Scale"].default_value = 7.0
    wall.inputs["Color1"].default_value = (0.42, 0.16, 0.1, 1)
    wall.inputs["Color2"].default_value = (0.28, 0.12, 0.09, 1)
    wall.inputs["Mortar"].default_value = (0.7, 0.67, 0.6, 1)
    where = tree.nodes.new("ShaderNodeTexCoord")
    tree.links.new(where.outputs["Generated"], wall.inputs["Vector"])
    tree.links.new(wall.outputs["Color"], shader.inputs["Base Color"])
    return material


def sky(elevation: float, rotation: float, strength: float) -> None:
    """A clear sky with a sun."""
    world = bpy.data.worlds.new("Sky")
    bpy.context.scene.world = world
    world.use_nodes = True
    tree = world.node_tree
    node = tree.nodes.new("ShaderNodeTexSky")
    # Blender 5.0 renamed Nishita's sky.
    node.sky_type = "NISHITA" if bpy.app.version < (5, 0) else "SINGLE_SCATTERING"
    node.sun_elevation, node.sun_rotation = math.radians(elevation), math.radians(rotation)
    node.sun_size, node.sun_intensity = math.radians(1.5), 0.5
    tree.links.new(node.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    tree.nodes["Background"].inputs["Strength"].default_value = strength


if __name__ == "__main__":
    main()
