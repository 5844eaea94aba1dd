"""Scenes of the suite for Blender's Cycles, made of its own primitives and textures.

:mod:`mcdenoise.scenes.cycles.blender` runs this script in Blender's Python, and renders what one of its functions has
built. Apart from the standard library and numpy it imports only Blender's module ``bpy``, which is under the GPL.

``gallery`` has lacquered planks, a brick wall, brushed steel, glass, a mirror, a lamp, a page of marks, thin rods, and
a head that moves. ``garden`` is outdoors under the sun and an HDR sky, with grass, a fence, lacquer and a glass ball.
``attic`` is a room of diffuse objects only, lit through a window. Each returns its :func:`camera`.
"""

from __future__ import annotations

import importlib
import math
import random
from typing import Any

import numpy as np

bpy: Any
try:
    bpy = importlib.import_module("bpy")
except ImportError:  # The Python that runs mcdenoise does not need bpy.
    bpy = None

Color = tuple[float, float, float]
_FOCUS, _STOP = 5.2, 0.35


def gallery(frames: int) -> dict[str, Any]:
    """An interior of glossy objects with a little sky light."""
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
    return camera(
        frames, 30, lambda step: (0.5 - 0.12 * step, -5.0 + 0.06 * step, 1.55 + 0.03 * step), (0.0, 0.9, 0.95)
    )


def garden(frames: int) -> dict[str, Any]:
    """An outdoor scene with a bright sun, sharp shadows and thin objects."""
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
    return camera(frames, 32, lambda step: (-0.8 + 0.14 * step, -5.6, 1.5), (0.1, 0.8, 0.75))


def attic(frames: int) -> dict[str, Any]:
    """A closed room of diffuse objects; light from the window reaches most of it after several bounces."""
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
    return camera(frames, 24, lambda step: (-0.3 + 0.08 * step, -2.85, 1.35), (0.0, 0.9, 0.8))


def camera(frames: int, lens: float, place: Any, target: Color) -> dict[str, Any]:
    """A camera that moves along a path and looks at one point: settings of ``build`` in Blender's script.

    Args:
        frames: number of frames; there are poses from one before the first to one after the last.
        lens: focal length in millimetres, for a sensor of 36.
        place: gives the location of each frame.
        target: the point.
    """
    poses = []
    for step in range(-1, frames + 1):
        forward = np.subtract(target, place(step))
        left = np.cross((0, 0, 1), forward)
        pose = np.eye(4)
        pose[:3] = np.stack([left, np.cross(forward, left), forward, place(step)], 1)
        pose[:, :3] /= np.linalg.norm(pose[:, :3], axis=0)
        poses.append(pose)
    fov = math.degrees(2 * math.atan(18 / lens))
    return {"cameras": poses, "fov_x": [fov] * len(poses), "aperture": lens * 1e-3 / (2 * _STOP), "focus": _FOCUS}


def path(thing: Any, frames: int, place: Any) -> None:
    """Animate the location, from one frame before the first to one after the last, which the Vector pass needs."""
    bpy.context.preferences.edit.keyframe_new_interpolation_type = "LINEAR"
    for step in range(-1, frames + 1):
        thing.location = place(step)
        thing.keyframe_insert("location", frame=step)


def plane(
    name: str, where: Color, turned: Color, size: tuple[float, float], material: Any, height: float | None = None
) -> None:
    """Add a rectangle, or a box if a height is given."""
    make = bpy.ops.mesh.primitive_plane_add if height is None else bpy.ops.mesh.primitive_cube_add
    make(size=1, location=where, rotation=turned)
    bpy.context.object.scale = (*size, 1 if height is None else height)
    finish(name, material, smooth=False)


def ball(name: str, where: Color, radius: float, material: Any) -> None:
    """Add a sphere."""
    bpy.ops.mesh.primitive_uv_sphere_add(radius=radius, location=where, segments=64, ring_count=32)
    finish(name, material)


def cylinder(name: str, where: Color, radius: float, height: float, material: Any) -> None:
    """Add an upright cylinder."""
    bpy.ops.mesh.primitive_cylinder_add(radius=radius, depth=height, location=where, vertices=48)
    finish(name, material, smooth=False)


def finish(name: str, material: Any, smooth: bool = True) -> Any:
    """Name the active object and assign its material."""
    thing = bpy.context.object
    thing.name = name
    thing.data.materials.append(material)
    thing.data.polygons.foreach_set("use_smooth", [smooth] * len(thing.data.polygons))
    return thing


def surface(name: str, **inputs: Any) -> tuple[Any, Any, Any]:
    """A material of one Principled BSDF, its node tree, and the BSDF's node."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    for key, value in inputs.items():
        shader.inputs[key.replace("_", " ")].default_value = value
    return material, material.node_tree, shader


def matt(name: str, color: Color) -> Any:
    """A diffuse material without any specular reflection."""
    return surface(name, Base_Color=(*color, 1), Roughness=1.0, Specular_IOR_Level=0.0)[0]


def metal(name: str, value: float, roughness: float, color: Color = (1.0, 1.0, 1.02)) -> Any:
    """A metal, from a perfect mirror to a rough one."""
    shade = tuple(value * channel for channel in color)
    return surface(name, Base_Color=(*shade, 1), Metallic=1.0, Roughness=roughness)[0]


def glass(color: Color) -> Any:
    """Solid glass."""
    return surface("Glass", Base_Color=(*color, 1), Roughness=0.0, IOR=1.5, Transmission_Weight=1.0)[0]


def coat(name: str, color: Color) -> Any:
    """A dark color under clear lacquer."""
    return surface(name, Base_Color=(*color, 1), Roughness=0.7, Coat_Weight=1.0, Coat_Roughness=0.02)[0]


def lamp(strength: float, color: Color) -> Any:
    """An emissive material."""
    return surface("Lamp", Emission_Color=(*color, 1), Emission_Strength=strength)[0]


def patterned(name: str, kind: str, low: Color, high: Color, output: str, scale: float, **inputs: Any) -> Any:
    """A material whose color is interpolated between two colors by a procedural texture in object coordinates."""
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
    """Lacquered dark wood with a strong grain."""
    lacquer = {"Roughness": 0.5, "Coat_Weight": 1.0, "Coat_Roughness": 0.05}
    material, node, _ = patterned(
        "Planks", "ShaderNodeTexWave", (0.02, 0.01, 0.006), (0.2, 0.1, 0.05), "Fac", 9.0, **lacquer
    )
    node.inputs["Distortion"].default_value, node.inputs["Detail"].default_value = 6.0, 6.0
    return material


def boards() -> Any:
    """Diffuse wood."""
    material, node, _ = patterned(
        "Boards", "ShaderNodeTexWave", (0.2, 0.12, 0.07), (0.5, 0.34, 0.2), "Fac", 14.0, Roughness=1.0
    )
    node.inputs["Distortion"].default_value = 3.0
    return material


def marks() -> Any:
    """A page of fine black marks on white."""
    _, node, ramp = made = patterned(
        "Marks", "ShaderNodeTexVoronoi", (0.02, 0.02, 0.02), (0.85, 0.85, 0.82), "Distance", 34.0, Roughness=1.0
    )
    node.distance = "MANHATTAN"
    ramp.color_ramp.interpolation = "CONSTANT"
    ramp.color_ramp.elements[1].position = 0.42
    return made[0]


def soil() -> Any:
    """Soil of many shades."""
    return patterned("Soil", "ShaderNodeTexNoise", (0.05, 0.03, 0.02), (0.4, 0.3, 0.2), "Fac", 60.0, Roughness=1.0)[0]


def checks() -> Any:
    """A checkerboard."""
    return patterned("Checks", "ShaderNodeTexChecker", (0.06, 0.07, 0.1), (0.75, 0.7, 0.6), "Fac", 8.0)[0]


def bricks() -> Any:
    """A wall of bricks with bright mortar."""
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
    """A clear sky with its sun."""
    world = bpy.data.worlds.new("Sky")
    bpy.context.scene.world = world
    world.use_nodes = True
    tree = world.node_tree
    node = tree.nodes.new("ShaderNodeTexSky")
    # Blender 5.0 renamed Nishita's sky model.
    node.sky_type = "NISHITA" if bpy.app.version < (5, 0) else "SINGLE_SCATTERING"
    node.sun_elevation, node.sun_rotation = math.radians(elevation), math.radians(rotation)
    node.sun_size, node.sun_intensity = math.radians(1.5), 0.5
    tree.links.new(node.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    tree.nodes["Background"].inputs["Strength"].default_value = strength
