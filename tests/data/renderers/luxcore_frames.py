"""Render two frames of a small scene with LuxCore, one file a buffer, into ``RGB_0001.exr``, ``ALBEDO_0001.exr``...

    python luxcore_frames.py -o luxcore

LuxCore gives no names of its own to the files: they are called here as it calls the outputs. The scene holds a matt
checkered floor, a wall, a rough metal ball, a glass ball, a lamp that is seen and an even sky. The
camera moves.
"""

import argparse
import math
from pathlib import Path

OUTPUTS = ("RGB", "ALPHA", "ALBEDO", "AVG_SHADING_NORMAL", "SHADING_NORMAL", "DEPTH", "POSITION", "SAMPLECOUNT")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--size", default="64x36")
    parser.add_argument("--samples", type=int, default=4)
    args = parser.parse_args()

    # Collecting the tests of this folder must not require LuxCore.
    import pyluxcore

    pyluxcore.Init()
    args.output.mkdir(parents=True, exist_ok=True)
    width, height = (int(number) for number in args.size.split("x"))
    for frame in (1, 2):
        settings = {
            "renderengine.type": ["PATHCPU"],
            "renderengine.seed": [frame],
            "sampler.type": ["SOBOL"],
            "native.threads.count": [1],
            "batch.haltspp": [args.samples],
            "film.width": [width],
            "film.height": [height],
            "film.filter.type": ["NONE"],
            "film.imagepipelines.0.0.type": ["NOP"],
        }
        for number, kind in enumerate(OUTPUTS):
            settings[f"film.outputs.{number}.type"] = [kind]
            settings[f"film.outputs.{number}.filename"] = [str(args.output / f"{kind}_{frame:04d}.exr")]
        config = pyluxcore.RenderConfig(properties(pyluxcore, settings), describe(pyluxcore, frame))
        session = pyluxcore.RenderSession(config)
        session.Start()
        while not session.HasDone():
            session.UpdateStats()
        session.Stop()
        session.GetFilm().SaveOutputs()


def describe(pyluxcore, frame):
    scene = pyluxcore.Scene()
    settings = {
        "scene.camera.type": ["perspective"],
        "scene.camera.lookat.orig": [-0.5 + 0.15 * frame, -5.0, 1.5],
        "scene.camera.lookat.target": [0.0, 0.0, 0.9],
        "scene.camera.up": [0.0, 0.0, 1.0],
        "scene.camera.fieldofview": [50.0],
        "scene.lights.sky.type": ["constantinfinite"],
        "scene.lights.sky.color": [0.25, 0.35, 0.5],
        "scene.textures.checks.type": ["checkerboard2d"],
        "scene.textures.checks.texture1": [0.6, 0.5, 0.35],
        "scene.textures.checks.texture2": [0.1, 0.12, 0.16],
        "scene.textures.checks.mapping.type": ["uvmapping2d"],
        "scene.textures.checks.mapping.uvscale": [8.0, 8.0],
        "scene.materials.floor.type": ["matte"],
        "scene.materials.floor.kd": ["checks"],
        "scene.materials.wall.type": ["matte"],
        "scene.materials.wall.kd": [0.6, 0.25, 0.15],
        "scene.materials.metal.type": ["metal2"],
        "scene.materials.metal.uroughness": [0.15],
        "scene.materials.metal.vroughness": [0.15],
        "scene.materials.glass.type": ["glass"],
        "scene.materials.glass.kr": [1.0, 1.0, 1.0],
        "scene.materials.glass.kt": [1.0, 1.0, 1.0],
        "scene.materials.glass.interiorior": [1.5],
        "scene.materials.lamp.type": ["matte"],
        "scene.materials.lamp.kd": [0.0, 0.0, 0.0],
        "scene.materials.lamp.emission": [25.0, 18.0, 10.0],
    }
    shapes = {
        "floor": rectangle((-6, -6, 0), (12, 0, 0), (0, 12, 0)),
        "wall": rectangle((-4, 2, 0), (8, 0, 0), (0, 0, 1.8)),
        "metal": ball((-1.0, 0.0, 0.7), 0.7),
        "glass": ball((0.9, -0.9, 0.5), 0.5),
        # LuxCore takes each triangle as a light, so the lamp has few.
        "lamp": ball((1.4, 0.6, 1.9), 0.3, rings=4, segments=6),
    }
    for name, (points, triangles, normals, uvs) in shapes.items():
        scene.DefineMesh(name, points, triangles, normals, uvs, None, None)
        settings[f"scene.objects.{name}.shape"] = [name]
        settings[f"scene.objects.{name}.material"] = [name]
    scene.Parse(properties(pyluxcore, settings))
    return scene


def properties(pyluxcore, settings):
    found = pyluxcore.Properties()
    for key, values in settings.items():
        found.Set(pyluxcore.Property(key, values))
    return found


def rectangle(corner, along, up):
    """Points, triangles, normals and texture coordinates of a parallelogram."""
    uvs = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
    points = [tuple(c + u * a + v * b for c, a, b in zip(corner, along, up, strict=True)) for u, v in uvs]
    return [tuple(map(float, point)) for point in points], [(0, 1, 2), (0, 2, 3)], None, uvs


def ball(center, radius, rings=24, segments=48):
    """Points, triangles, normals and texture coordinates of a sphere."""
    points, normals, uvs, triangles = [], [], [], []
    for ring in range(rings + 1):
        for segment in range(segments + 1):
            polar, azimuth = math.pi * ring / rings, 2 * math.pi * segment / segments
            normal = (math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar))
            normals.append(normal)
            points.append(tuple(c + radius * n for c, n in zip(center, normal, strict=True)))
            uvs.append((segment / segments, ring / rings))
            if ring < rings and segment < segments:
                here = ring * (segments + 1) + segment
                below = here + segments + 1
                triangles += [(here, below, below + 1), (here, below + 1, here + 1)]
    return points, triangles, normals, uvs


if __name__ == "__main__":
    main()
