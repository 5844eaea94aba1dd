"""The script for Blender's Python: builds scenes, renders their frames, and answers in lines of JSON.

The script needs ``bpy`` and its numpy, and nothing of mcdenoise. It reads one command per line from its input, such as
``{"do": "render", "frame": 0, ...}``, and answers each with one line, ``{"ok": ...}`` or ``{"error": ...}``. Blender's
own output goes to the standard error.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np

bpy: Any
Matrix: Any
try:
    bpy = importlib.import_module("bpy")
    Matrix = importlib.import_module("mathutils").Matrix
except ImportError:  # The script is also imported without Blender.
    bpy = Matrix = None

# Mitsuba's cameras look along +z with +x to the left; Blender's look along -z with +x to the right.
_CAMERA = np.diag((-1.0, 1.0, -1.0, 1.0))


def main() -> None:
    """Answer commands until the input ends."""
    # Output of Blender's own code must not be mixed with the answers.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    if bpy is None:
        print(json.dumps({"error": "there is no module 'bpy'"}), file=answers, flush=True)
        return
    print(json.dumps({"ok": bpy.app.version_string}), file=answers, flush=True)
    commands: dict[str, Any] = {"scene": build, "script": build_by, "render": render}
    for line in sys.stdin:
        command = json.loads(line)
        try:
            answer = {"ok": commands[command.pop("do")](**command)}
        except Exception as error:  # Every error is sent as an answer.
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


def build(folder: str, settings: dict[str, Any]) -> None:
    """Build the scene described by ``scene.json`` and ``scene.npz`` in a folder.

    Args:
        folder: folder of the files.
        settings: ``size``, ``threads``, ``filter_width``, ``box``; ``cameras``, ``fov_x`` and ``moves`` for every
            frame, from one before the first to one after the last; ``aperture`` (radius) and ``focus``; ``shutter``;
            ``passes``, by their names in Blender's Python; ``clamped``, whether Cycles clamps and thresholds light.
    """
    content = json.loads((Path(folder) / "scene.json").read_text(encoding="utf-8"))
    with np.load(Path(folder) / "scene.npz", allow_pickle=False) as file:
        arrays = dict(file)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    images = {name: _image(name, pixels) for name, pixels in arrays.items() if name.startswith(("texture", "sky"))}
    materials = [_material(number, entry, images) for number, entry in enumerate(content["materials"])]
    for entry in content["objects"]:
        thing = _object(entry, arrays, materials)
        scene.collection.objects.link(thing)
        if entry["moves"]:
            thing.pass_index = entry["index"]
            _animate(thing, settings["moves"][entry["id"]])
    for number, light in enumerate(content["lights"]):
        scene.collection.objects.link(_light(number, light))
    scene.world = _world(content["sky"], images)
    _set_up(scene, settings)


def build_by(script: str, name: str, frames: int, settings: dict[str, Any]) -> None:
    """Build a scene by a function of another script, which gets the number of frames and returns the camera's settings.

    Args:
        script: path of the script.
        name: of the function.
        frames: number of frames.
        settings: see :func:`build`; those of the camera are the function's but for ``aperture``, if it is 0.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    _set_up(bpy.context.scene, runpy.run_path(script)[name](frames) | settings)


def render(frame: int, samples: int, seed: int, out: str) -> None:
    """Render one frame to a multilayer EXR.

    Args:
        frame: number of the frame.
        samples: samples per pixel.
        seed: noise seed.
        out: the file, ending in ``.exr``.
    """
    scene = bpy.context.scene
    scene.frame_set(frame)
    scene.cycles.samples, scene.cycles.seed = samples, seed
    scene.render.filepath = out
    bpy.ops.render.render(write_still=True)


def _set_up(scene: Any, settings: dict[str, Any]) -> None:
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = settings["size"]
    scene.render.resolution_percentage = 100
    # Keep the scene in Cycles between renderings, because loading it takes longer than one sample per pixel.
    scene.render.use_persistent_data = True
    if settings["threads"]:
        scene.render.threads_mode, scene.render.threads = "FIXED", settings["threads"]
    layer = scene.view_layers[0]
    layer.cycles.denoising_store_passes = bool(settings["passes"])
    layer.use_pass_z = False
    for name in settings["passes"]:
        setattr(layer, f"use_pass_{name}", True)
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    if not settings["clamped"]:
        cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
        # A brightness threshold would make the result depend on the unit of radiance.
        cycles.light_sampling_threshold = 0
    # A box filter in Cycles is always one pixel wide, so the narrow filter has the default type.
    cycles.pixel_filter_type = "BOX" if settings["box"] else "BLACKMAN_HARRIS"
    cycles.filter_width = settings["filter_width"]
    image = scene.render.image_settings
    if bpy.app.version >= (5, 0):
        image.media_type = "MULTI_LAYER_IMAGE"
        image.use_exr_interleave = True
    image.file_format = "OPEN_EXR_MULTILAYER"
    image.color_depth, image.exr_codec = "32", "NONE"
    scene.render.use_motion_blur = settings["shutter"] > 0
    if settings["shutter"]:
        scene.render.motion_blur_shutter = settings["shutter"]
    poses = [np.array(pose) @ _CAMERA for pose in settings["cameras"]]
    data = bpy.data.cameras.new("Camera")
    camera = bpy.data.objects.new("Camera", data)
    scene.collection.objects.link(camera)
    scene.camera = camera
    data.sensor_fit = "HORIZONTAL"
    data.clip_start, data.clip_end = 1e-3, 1e6
    # Motion blur also needs placements before and after the frames.
    for index, fov in enumerate(settings["fov_x"]):
        data.angle = math.radians(fov)
        data.keyframe_insert("lens", frame=index - 1)
    scene.frame_start, scene.frame_end = 0, len(poses) - 3
    _animate(camera, poses)
    scene.frame_set(0)
    if settings["aperture"]:
        data.dof.use_dof, data.dof.focus_distance = True, settings["focus"]
        data.dof.aperture_fstop = data.lens * 1e-3 / (2 * settings["aperture"])


def _animate(thing: Any, poses: Any) -> None:
    """Keyframes of an object, from one before the first frame to one after the last."""
    bpy.context.preferences.edit.keyframe_new_interpolation_type = "LINEAR"
    thing.rotation_mode = "QUATERNION"
    before = None
    for index, pose in enumerate(poses):
        location, rotation, scale = Matrix(np.array(pose).tolist()).decompose()
        if before is not None:
            # Two quaternions describe a rotation; interpolating between opposite signs would rotate the object once
            # around.
            rotation.make_compatible(before)
        before = rotation
        thing.location, thing.rotation_quaternion, thing.scale = location, rotation, scale
        for path in ("location", "rotation_quaternion", "scale"):
            thing.keyframe_insert(path, frame=index - 1)


def _object(entry: dict[str, Any], arrays: dict[str, Any], materials: list[Any]) -> Any:
    vertices, triangles, uv, smooth, used = (
        arrays[f"{entry['array']}_{key}"] for key in ("vertices", "triangles", "uv", "smooth", "material")
    )
    name = entry["id"] or "rest"
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", vertices.ravel())
    mesh.loops.add(triangles.size)
    mesh.loops.foreach_set("vertex_index", triangles.ravel())
    mesh.polygons.add(len(triangles))
    mesh.polygons.foreach_set("loop_start", np.arange(0, triangles.size, 3, dtype=np.int32))
    slots, numbers = np.unique(used, return_inverse=True)
    for slot in slots:
        mesh.materials.append(materials[slot])
    mesh.polygons.foreach_set("material_index", numbers.ravel().astype(np.int32))
    mesh.polygons.foreach_set("use_smooth", smooth)
    mesh.uv_layers.new(name="UVMap").data.foreach_set("uv", uv.ravel())
    mesh.update(calc_edges=True)
    return bpy.data.objects.new(name, mesh)


def _image(name: str, pixels: Any) -> Any:
    """An image of linear values; the first row is at v = 0, as in Mitsuba, except for the sky's."""
    height, width, _ = pixels.shape
    image = bpy.data.images.new(name, width, height, alpha=False, float_buffer=True, is_data=True)
    rows = pixels[::-1] if name == "sky" else pixels
    image.pixels.foreach_set(np.concatenate([rows, np.ones((height, width, 1), np.float32)], -1).ravel())
    image.update()
    return image


def _material(number: int, entry: dict[str, Any], images: dict[str, Any]) -> Any:
    material = bpy.data.materials.new(f"material{number}")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    shader = _pane(tree, entry["pane"]) if "pane" in entry else _principled(tree, entry["inputs"], images)
    if "radiance" in entry:
        strength: Any = max(entry["radiance"])
        color = (*(channel / strength for channel in entry["radiance"]), 1)
        if entry["one_sided"]:
            behind = _node(tree, "NewGeometry").outputs["Backfacing"]
            strength = _math(tree, "MULTIPLY_ADD", behind, -strength, strength)
            material.cycles.emission_sampling = "FRONT"
        lamp = _node(tree, "Emission", {"Color": color, "Strength": strength}).outputs[0]
        shader = _node(tree, "AddShader", {0: shader, 1: lamp}).outputs[0]
    _node(tree, "OutputMaterial", {"Surface": shader})
    return material


def _node(tree: Any, kind: str, inputs: dict[Any, Any] | None = None, **settings: Any) -> Any:
    """A new node; an input is a value or another node's output."""
    node = tree.nodes.new(f"ShaderNode{kind}")
    for name, value in settings.items():
        setattr(node, name, value)
    for key, value in (inputs or {}).items():
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, node.inputs[key])
        else:
            node.inputs[key].default_value = value
    return node


def _math(tree: Any, operation: str, *inputs: Any) -> Any:
    return _node(tree, "Math", dict(enumerate(inputs)), operation=operation).outputs[0]


def _principled(tree: Any, inputs: dict[str, Any], images: dict[str, Any]) -> Any:
    node = _node(tree, "BsdfPrincipled")
    for name, value in inputs.items():
        socket = node.inputs[name]
        if isinstance(value, dict):
            color = _texture(tree, value, images)
            if name == "Normal":
                color = _node(tree, "NormalMap", {"Color": color}).outputs["Normal"]
            tree.links.new(color, socket)
        elif socket.type == "RGBA":
            socket.default_value = (*value, 1)
        else:
            socket.default_value = value[0] if isinstance(value, list) else value
    return node.outputs[0]


def _texture(tree: Any, value: dict[str, Any], images: dict[str, Any]) -> Any:
    uv = _node(tree, "TexCoord").outputs["UV"]
    scaled = _node(tree, "Mapping", {"Scale": (*value["scale"], 1), "Vector": uv}).outputs[0]
    settings = {"image": images[value["texture"]], "interpolation": "Linear", "extension": "REPEAT"}
    return _node(tree, "TexImage", {"Vector": scaled}, **settings).outputs["Color"]


def _pane(tree: Any, ior: float) -> Any:
    """Glass without refraction: it reflects 2 F / (1 + F) of the light and transmits the rest."""
    # The Fresnel node inverts the index on the back side of a surface, but a pane has no inside.
    behind = _node(tree, "NewGeometry").outputs["Backfacing"]
    index = _math(tree, "POWER", ior, _math(tree, "MULTIPLY_ADD", behind, -2.0, 1.0))
    fresnel = _node(tree, "Fresnel", {"IOR": index}).outputs[0]
    mirrored = _math(tree, "DIVIDE", _math(tree, "MULTIPLY", fresnel, 2.0), _math(tree, "ADD", fresnel, 1.0))
    glossy = _node(tree, "BsdfGlossy", {"Roughness": 0, "Color": (1, 1, 1, 1)}).outputs[0]
    clear = _node(tree, "BsdfTransparent").outputs[0]
    return _node(tree, "MixShader", {0: mirrored, 1: clear, 2: glossy}).outputs[0]


def _light(number: int, light: dict[str, Any]) -> Any:
    data = bpy.data.lights.new(f"light{number}", light["type"].upper())
    strength = max(light["intensity"])
    data.color = [channel / strength for channel in light["intensity"]]
    # Convert watts per steradian to total watts.
    data.energy = 4 * math.pi * strength
    data.shadow_soft_size = 0.0
    thing = bpy.data.objects.new(data.name, data)
    if light["type"] == "spot":
        thing.matrix_world = Matrix((np.array(light["to_world"]) @ _CAMERA).tolist())
        data.spot_size = 2 * math.radians(light["cutoff"])
        # Mitsuba's spots have three quarters of their cone with constant intensity.
        data.spot_blend = 0.25
    else:
        thing.location = light["position"]
    return thing


def _world(sky: dict[str, Any] | None, images: dict[str, Any]) -> Any:
    world = bpy.data.worlds.new("World")
    world.use_nodes = True
    tree = world.node_tree
    background = tree.nodes["Background"]
    background.inputs["Color"].default_value = (*(sky or {}).get("value", (0, 0, 0)), 1)
    if sky is not None and "texture" in sky:
        # Blender's images are around z and begin at -x, Mitsuba's around y and begin at -z: (z, x, y), not (x, y, z).
        parts = _node(tree, "SeparateXYZ", {0: _node(tree, "TexCoord").outputs["Generated"]}).outputs
        turned = _node(tree, "CombineXYZ", {0: parts[2], 1: parts[0], 2: parts[1]}).outputs[0]
        settings = {"image": images[sky["texture"]], "interpolation": "Linear"}
        color = _node(tree, "TexEnvironment", {"Vector": turned}, **settings).outputs["Color"]
        tree.links.new(color, background.inputs["Color"])
    return world


if __name__ == "__main__":
    main()
