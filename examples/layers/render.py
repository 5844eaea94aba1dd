"""Render a shot with a layer for each kind of light in Cycles: ``python render.py OUT``, a quarter of an hour.

Eight frames at one sample a pixel, ``OUT/noisy_0001.exr`` and so on, and references of three of them at 512
samples. It imports Blender as a module (``pip install bpy==4.5.15``, Python 3.11, GPL) and nothing of this package.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector

FRAMES, REFERENCES, SAMPLES = 8, (1, 4, 8), 512


def material(name: str, color: tuple[float, float, float], *, texture: bool = False, **inputs: Any) -> Any:
    """A principled surface, with a checkerboard of its color and a third of it where that is asked for."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    surface = made.node_tree.nodes["Principled BSDF"]
    for key, value in ({"Base Color": (*color, 1)} | inputs).items():
        surface.inputs[key].default_value = value
    if texture:
        checker = made.node_tree.nodes.new("ShaderNodeTexChecker")
        checker.inputs["Scale"].default_value = 12
        checker.inputs["Color1"].default_value = (*color, 1)
        checker.inputs["Color2"].default_value = (*(0.3 * each for each in color), 1)
        made.node_tree.links.new(checker.outputs["Color"], surface.inputs["Base Color"])
    return made


def add(primitive: Any, surface: Any, **settings: Any) -> Any:
    """An object of that surface."""
    primitive(**settings)
    bpy.context.object.data.materials.append(surface)
    return bpy.context.object


def build(scene: Any) -> None:
    """A room with things of metal, glass, plastic and light."""
    meshes = bpy.ops.mesh
    plane, right = meshes.primitive_plane_add, math.pi / 2
    add(plane, material("floor", (0.8, 0.7, 0.5), texture=True, Roughness=0.25), size=12)
    wall = material("wall", (0.7, 0.75, 0.8), texture=True, Roughness=0.9)
    add(plane, wall, size=12, location=(0, 4, 0), rotation=(right, 0, 0))
    add(plane, material("side", (0.8, 0.2, 0.15), Roughness=0.6), size=12, location=(-4, 0, 0), rotation=(0, right, 0))
    orange, glass = (1.0, 0.6, 0.2), {"Transmission Weight": 1.0}
    surfaces = [
        material("gold", (1.0, 0.75, 0.3), Roughness=0.2, Metallic=1.0),
        material("rough", (0.9, 0.9, 0.9), Roughness=0.45, Metallic=1.0),
        material("glass", (1.0, 1.0, 1.0), Roughness=0.02, **glass),
        material("plastic", (0.1, 0.3, 0.8), Roughness=0.15),
        material("matte", (0.3, 0.7, 0.3), Roughness=0.9),
        material("glow", orange, **{"Emission Color": (*orange, 1), "Emission Strength": 3.0}),
        material("frosted", (0.9, 1.0, 0.95), Roughness=0.3, **glass),
    ]
    for index, surface in enumerate(surfaces):
        round_one = index % 2 == 0
        shape = meshes.primitive_uv_sphere_add if round_one else meshes.primitive_cube_add
        thing = add(shape, surface, location=(-2.4 + 0.85 * index, 0.6 * math.sin(2.1 * index), 0.45))
        thing.scale = (0.42,) * 3
        for polygon in thing.data.polygons if round_one else ():
            polygon.use_smooth = True
        if not round_one:
            thing.rotation_euler = (0, 0, 0.5 * index)
    lamp = bpy.data.lights.new("lamp", "AREA")
    lamp.energy, lamp.size = 180, 1.5
    placed = bpy.data.objects.new("lamp", lamp)
    placed.location = (1.5, -1, 4)
    scene.collection.objects.link(placed)
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    background = scene.world.node_tree.nodes["Background"].inputs
    background[0].default_value, background[1].default_value = (0.3, 0.45, 0.8, 1), 0.4


def move_camera(scene: Any) -> None:
    """A little to the right from frame to frame; with a key before the first and behind the last one."""
    lens = bpy.data.cameras.new("camera")
    lens.lens = 32
    scene.camera = bpy.data.objects.new("camera", lens)
    scene.collection.objects.link(scene.camera)
    for frame in range(FRAMES + 2):
        scene.camera.location = (-0.6 + 0.05 * frame, -5.2 + 0.02 * frame, 1.9)
        forward = Vector((0.1, 0, 0.6)) - scene.camera.location
        scene.camera.rotation_euler = forward.to_track_quat("-Z", "Y").to_euler()
        for path in ("location", "rotation_euler"):
            scene.camera.keyframe_insert(path, frame=frame)
    for curve in scene.camera.animation_data.action.fcurves:
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"


def main(out: Path) -> None:
    """Render all files."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.render.resolution_x, scene.render.resolution_y = 320, 180
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.cycles.sample_clamp_indirect, scene.cycles.max_bounces = 0, 6
    build(scene)
    move_camera(scene)
    layer = scene.view_layers[0]
    kinds = [
        f"{kind}_{part}" for kind in ("diffuse", "glossy", "transmission") for part in ("direct", "indirect", "color")
    ]
    for name in ("combined", "z", "vector", "emit", "environment", *kinds):
        setattr(layer, f"use_pass_{name}", True)
    layer.cycles.denoising_store_passes = True
    scene.render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    scene.render.image_settings.color_depth = "32"
    for samples, name, frames in ((1, "noisy", range(1, FRAMES + 1)), (SAMPLES, "reference", REFERENCES)):
        scene.cycles.samples = samples
        for frame in frames:
            scene.frame_set(frame)
            scene.cycles.seed = 1000 * samples + frame
            scene.render.filepath = str(out / f"{name}_{frame:04d}.exr")
            bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
