"""Render three frames of a small scene with Mitsuba 3, its `aov` integrator around `path`, into ``frame.0001.exr``...

    python mitsuba_frames.py -o mitsuba

The scene holds a checkered floor, a wall, a rough golden ball, a glass ball and a lamp that is seen; above the wall
there is nothing. The camera moves. ``as_tensor.exr`` is the first frame at half the size as ``mi.util.write_bitmap``
writes the array that ``mi.render`` returns: that array has no channel names.
"""

import argparse
from pathlib import Path

AOVS = "albedo:albedo,nn:sh_normal,dd.y:depth,pos:position"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--size", default="64x36")
    parser.add_argument("--samples", type=int, default=4)
    args = parser.parse_args()

    # Collecting the tests of this folder must not require Mitsuba.
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    args.output.mkdir(parents=True, exist_ok=True)
    width, height = (int(number) for number in args.size.split("x"))
    for frame in range(1, 4):
        scene = mi.load_dict(describe(mi, frame, width, height, args.samples))
        mi.render(scene, seed=frame)
        scene.sensors()[0].film().write(str(args.output / f"frame.{frame:04d}.exr"))
    small = mi.load_dict(describe(mi, 1, width // 2, height // 2, args.samples))
    mi.util.write_bitmap(str(args.output / "as_tensor.exr"), mi.render(small, seed=1), write_async=False)


def describe(mi, frame, width, height, samples):
    place = mi.ScalarTransform4f
    checks = {
        "type": "checkerboard",
        "color0": {"type": "rgb", "value": [0.6, 0.5, 0.35]},
        "color1": {"type": "rgb", "value": [0.1, 0.12, 0.16]},
        "to_uv": place().scale([8, 8, 1]),
    }
    return {
        "type": "scene",
        "integrator": {"type": "aov", "aovs": AOVS, "image": {"type": "path", "max_depth": 6}},
        "sensor": {
            "type": "perspective",
            "fov": 50,
            "to_world": place().look_at(origin=[-0.5 + 0.15 * frame, 1.5, 5.0], target=[0, 0.9, 0], up=[0, 1, 0]),
            "sampler": {"type": "independent", "sample_count": samples},
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": "rgb",
                "component_format": "float16",
                "rfilter": {"type": "box"},
            },
        },
        "floor": {
            "type": "rectangle",
            "to_world": place().rotate([1, 0, 0], -90).scale(6),
            "bsdf": {"type": "diffuse", "reflectance": checks},
        },
        "wall": {
            "type": "rectangle",
            "to_world": place().translate([0, 0.9, -2]).scale([4, 0.9, 1]),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.25, 0.15]}},
        },
        "gold": {
            "type": "sphere",
            "center": [-1.0, 0.7, 0],
            "radius": 0.7,
            "bsdf": {"type": "roughconductor", "material": "Au", "alpha": 0.1},
        },
        "glass": {"type": "sphere", "center": [0.9, 0.5, 0.9], "radius": 0.5, "bsdf": {"type": "dielectric"}},
        "lamp": {
            "type": "sphere",
            "center": [1.4, 1.9, -0.6],
            "radius": 0.3,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [25.0, 18.0, 10.0]}},
        },
    }


if __name__ == "__main__":
    main()
