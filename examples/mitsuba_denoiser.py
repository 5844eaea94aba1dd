"""Replace `mi.OptixDenoiser` in a Mitsuba 3 script, and optimize a scene through the denoiser.

    python examples/mitsuba_denoiser.py -o mitsuba_denoiser

`still` renders a Cornell box at a few samples per pixel, with the albedo and the normals of the `aov` integrator, and
denoises the bitmap. `optimise` finds the color of the walls from an image of them: each step renders a new image at one
sample per pixel, and the gradient of the loss propagates back through the denoiser into Mitsuba. It needs a
differentiable variant, `cuda_ad_rgb` or `llvm_ad_rgb`, which needs LLVM 19 or newer, and is skipped with a message if
neither works.

Measured at 96x96: at 4 samples per pixel, SMAPE falls from 0.314 to 0.148; in llvm_ad_rgb, after 60 steps, the maximum
error of the walls' reflectance has fallen from 0.586 to 0.007.
"""

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np

from mcdenoise.integrations.mitsuba import MitsubaDenoiser
from mcdenoise.scenes.render.loading import LLVM, first_working

WALLS = "white.reflectance.value"
START = (0.3, 0.3, 0.3)


def cornell_box(size: int) -> dict:
    box = mi.cornell_box()
    # A box filter, because denoisers expect independent noise in each pixel.
    box["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": "box"}}
    # Render image and features in one pass.
    box["integrator"] = {
        "type": "aov",
        "aovs": "albedo:albedo,normals:sh_normal",
        "image": {"type": "path", "max_depth": 6},
    }
    return box


def still(out: Path, size: int, samples: int) -> tuple[float, float]:
    """Write the noisy and the denoised image, and return their errors."""
    scene = mi.load_dict(cornell_box(size))
    film = scene.sensors()[0].film()
    mi.render(scene, spp=samples, seed=1)
    bitmap = film.bitmap()

    # denoiser = mi.OptixDenoiser(film.size(), albedo=True, normals=True)
    denoiser = MitsubaDenoiser(film.size(), albedo=True, normals=True)
    denoised = denoiser(bitmap, albedo_ch="albedo", normals_ch="normals")

    noisy = dict(bitmap.split())["<root>"]
    mi.render(scene, spp=64 * samples, seed=2)
    reference = np.array(dict(film.bitmap().split())["<root>"])
    out.mkdir(parents=True, exist_ok=True)
    for name, image in (("noisy", noisy), ("denoised", denoised)):
        image.write(str(out / f"{name}.exr"))
    return error(np.array(noisy), reference), error(np.array(denoised), reference)


def error(image: np.ndarray, reference: np.ndarray) -> float:
    """Symmetric mean absolute percentage error."""
    return float(np.mean(2 * np.abs(image - reference) / (np.abs(image) + np.abs(reference) + 0.01)))


def optimise(size: int, steps: int) -> list[float]:
    """Maximum error of the walls' reflectance before the first and after each step."""
    import drjit as dr

    scene = mi.load_dict(cornell_box(size))
    parameters = mi.traverse(scene)
    true = mi.Color3f(parameters[WALLS])
    target = mi.render(scene, spp=256, seed=0)[..., :3]
    denoiser = MitsubaDenoiser((size, size), albedo=True, normals=True, model="cascaded_v2_micro")

    optimiser = mi.ad.Adam(lr=0.05)
    optimiser[WALLS] = mi.Color3f(*START)
    parameters.update(optimiser)
    errors = [float(dr.max(dr.abs(true - optimiser[WALLS]))[0])]
    for step in range(steps):
        rendered = mi.render(scene, parameters, spp=1, seed=step + 1)
        noisy, albedo, normals = rendered[..., :3], rendered[..., -6:-3], rendered[..., -3:]
        image = denoiser(noisy, albedo, normals)
        loss = dr.mean(dr.square(image - target) / (dr.square(target) + 0.01), axis=None)
        dr.backward(loss)
        optimiser.step()
        optimiser[WALLS] = dr.clip(optimiser[WALLS], 0.01, 0.99)
        # Decay the learning rate; with a constant one, Adam would not converge on noisy gradients.
        optimiser.set_learning_rate(0.05 * (1 - (step + 1) / steps))
        parameters.update(optimiser)
        errors.append(float(dr.max(dr.abs(true - optimiser[WALLS]))[0]))
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("mitsuba_denoiser"))
    parser.add_argument("--variant", default="scalar_rgb", help="Mitsuba variant for the still")
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--samples", type=int, default=4, help="samples per pixel of the still")
    parser.add_argument("--steps", type=int, default=60, help="steps of the optimization")
    options = parser.parse_args()

    mi.set_variant(options.variant)
    import drjit as dr

    # Loading a scene blocks on a single core unless there is a second thread.
    dr.set_thread_count(max(2, dr.thread_count()))
    noisy, denoised = still(options.out, options.size, options.samples)
    print(f"still: error {noisy:.3f} noisy, {denoised:.3f} denoised; wrote {options.out}/denoised.exr")

    variant = first_working(("cuda_ad_rgb", "llvm_ad_rgb"))
    if variant is None:
        print(f"optimise: skipped, as no differentiable variant of Mitsuba works here; {LLVM}")
        return
    mi.set_variant(variant)
    errors = optimise(options.size, options.steps)
    print(
        f"optimise in {variant}: error of the reflectance {errors[0]:.3f}, after {options.steps} steps {errors[-1]:.3f}"
    )


if __name__ == "__main__":
    main()
