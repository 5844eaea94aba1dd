"""Denoise frames inside Mitsuba's own loop on the GPU, without a copy through the host.

python examples/gpu/mitsuba_loop.py -o mitsuba_loop.json
"""

import time
from itertools import pairwise

import torch
from part import Part

from mcdenoise.errors import InputError
from mcdenoise.integrations.mitsuba import MitsubaDenoiser


def rendered(part: Part) -> dict[str, object]:
    """Render and denoise some frames; the medians of both times."""
    try:
        import mitsuba as mi
    except ImportError as error:
        raise InputError(f"mitsuba: expected the package for this part, found none ({error})") from error
    mi.set_variant("cuda_ad_rgb" if part.device.type == "cuda" else "scalar_rgb")
    size = (64, 48) if part.quick else (1280, 720)
    box = mi.cornell_box()
    box["sensor"]["film"] |= {"width": size[0], "height": size[1], "pixel_format": "rgb"}
    aovs = "albedo:albedo,normals:sh_normal"
    box["integrator"] = {"type": "aov", "aovs": aovs, "image": {"type": "path", "max_depth": 6}}
    scene, denoiser = mi.load_dict(box), MitsubaDenoiser(size, albedo=True, normals=True)
    times: list[list[float]] = []

    def frame() -> None:
        moments = [time.perf_counter()]
        # Color, albedo and normals, in this order.
        image = mi.render(scene, spp=1, seed=len(times))
        noisy, albedo, normals = (image[..., first : first + 3] for first in (0, 3, 6))
        for work in (lambda: None, lambda: denoiser(noisy, albedo=albedo, normals=normals)):
            work()
            if part.device.type == "cuda":
                torch.cuda.synchronize()
            moments.append(time.perf_counter())
        times.append([round((later - earlier) * 1e3, 1) for earlier, later in pairwise(moments)])

    for _ in range(3 if part.quick else 20):
        frame()
    return {"milliseconds to render, and to denoise": times}


def main() -> None:
    part = Part.begin(__doc__)
    part.attempt("mitsuba", lambda: rendered(part))


if __name__ == "__main__":
    main()
