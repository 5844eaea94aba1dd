"""Find a material by inverse rendering at one sample per pixel, with and without the denoiser in the loop.

    python examples/inverse_rendering.py -o inverse_rendering.png

Mitsuba 3 renders a Cornell box whose white walls have an unknown reflectance. Starting from a wrong value, Adam follows
the gradient of the distance to an image of the true box; each step renders a new image at one sample per pixel. The
differentiable denoiser is placed between the renderer and the loss; without it, the loss is computed from the noisy
image. There are two losses: the relative squared error, and the absolute difference of compressed radiance, log(1 + x),
which is common for its robustness against bright pixels. Noise biases the latter, because the mean of a concave
function of a noisy image is not that function of its mean.

If Mitsuba finds LLVM 19 or newer, the script uses Mitsuba's derivatives (``dr.wrap``). Otherwise it uses finite
differences with equal random numbers in the scalar variant, which are exact up to rounding here, because no path
depends on the reflectance and its three channels do not mix.

Measured at 64x64 with 120 samples per pixel and three noise seeds in the scalar variant: the maximum error of the
reflectance, 0.6 at the start, is 0.304 without and 0.015 with the denoiser for the squared loss, and 0.163 and 0.014
for the compressed one (seeds differ by at most 0.01). Without the denoiser more steps do not help: the image and its
derivative come from the same samples, so the gradient also reduces the noise, which makes the walls darker. The known
remedy, two independent images in each step whose differences are multiplied instead of squared, reaches 0.031 with the
same number of samples. So the denoiser helps, also for losses that are not squares; its own error remains, here 0.015.
"""

import argparse
import importlib
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from mcdenoise import Denoiser, Frame
from mcdenoise.scenes.render.loading import first_working

TRUE, START = (0.885, 0.699, 0.667), (0.3, 0.3, 0.3)
KEY = "white.reflectance.value"
STEP = 1e-2  # of the finite differences
SIZE = 64
LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "relative squared": lambda image, target: ((image - target).square() / (target.square() + 0.01)).mean(),
    "log, absolute": lambda image, target: (torch.log1p(image) - torch.log1p(target)).abs().mean(),
}


class Box:
    """The Cornell box; its images are differentiable in the reflectance of its white walls.

    Args:
        variant: Mitsuba variant.
        size: side of the image, in pixels.
    """

    def __init__(self, variant: str, size: int) -> None:
        import mitsuba as mi

        mi.set_variant(variant)
        self.mi, self.dr = mi, importlib.import_module("drjit")
        self.dr.set_thread_count(max(2, self.dr.thread_count()))
        box = mi.cornell_box()
        box["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": "box"}}
        # With Russian roulette, the length of a path would depend on the reflectance.
        box["integrator"] = {"type": "path", "max_depth": 6, "rr_depth": 100}
        self.scene = mi.load_dict(box)
        self.parameters = mi.traverse(self.scene)
        self.differentiates = "_ad_" in variant
        aovs = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal,depth:depth"}
        self._features = mi.load_dict(aovs)

    def plain(self, reflectance: Tensor, samples: int, seed: int) -> Tensor:
        """Render ``(1, 3, H, W)`` without derivatives."""
        self.parameters[KEY] = self.mi.Color3f(*reflectance.tolist())
        self.parameters.update()
        return _image(self.mi.render(self.scene, spp=samples, seed=seed))

    def __call__(self, reflectance: Tensor, seed: int) -> Tensor:
        """Render ``(1, 3, H, W)`` at one sample per pixel, differentiably."""
        if not self.differentiates:
            image = self.plain(reflectance.detach(), 1, seed)
            ahead = self.plain(reflectance.detach() + STEP, 1, seed)
            back = self.plain(reflectance.detach() - STEP, 1, seed)
            slope = (ahead - back) / (2 * STEP)
            return image + slope * (reflectance - reflectance.detach()).reshape(1, 3, 1, 1)

        @self.dr.wrap(source="torch", target="drjit")
        def render(value: object) -> object:
            self.parameters[KEY] = self.dr.unravel(self.mi.Color3f, value.array)
            self.parameters.update()
            return self.mi.render(self.scene, self.parameters, spp=1, seed=seed)

        return render(reflectance).permute(2, 0, 1)[None].float()

    def features(self) -> dict[str, Tensor]:
        """Normal and depth of the box, which do not depend on the reflectance."""
        found = _image(self.mi.render(self.scene, integrator=self._features, spp=64, seed=0))
        return {"normal": found[:, 3:6].clamp(-1, 1), "depth": found[:, 6:7].clamp_min(0)}


def _image(found: object) -> Tensor:
    import numpy as np

    return torch.from_numpy(np.array(found, dtype=np.float32)).permute(2, 0, 1)[None]


METHODS = {"relative squared": ("noisy", "noisy, two images", "denoised"), "log, absolute": ("noisy", "denoised")}


def descend(
    box: Box, target: Tensor, loss: str, denoiser: Denoiser | None, steps: int, seed: int, two: bool = False
) -> list[float]:
    """Maximum error of the reflectance after each step; with ``two``, each step renders two images."""
    features = box.features()
    logits = torch.logit(torch.tensor(START)).requires_grad_()
    optimizer = torch.optim.Adam([logits], lr=0.1)
    errors = []
    for step in range(steps):
        reflectance = torch.sigmoid(logits)
        errors.append(float((reflectance.detach() - torch.tensor(TRUE)).abs().max()))
        image = box(reflectance, seed * 100_003 + step)
        if denoiser is not None:
            # Denoise each image as a still, because the reflectance changes from step to step.
            denoiser.reset()
            image = denoiser(Frame(color=image.clamp_min(0), **features))
        optimizer.zero_grad()
        if two:
            # The mean of the product of independent differences does not contain the variance of the noise.
            other = box(reflectance, seed * 100_003 + steps + step)
            ((image - target) * (other - target) / (target.square() + 0.01)).mean().backward()
        else:
            LOSSES[loss](image, target).backward()
        optimizer.step()
        # Decay the learning rate; with a constant one, Adam would not converge on noisy gradients.
        optimizer.param_groups[0]["lr"] = 0.1 * (1 - step / steps)
    errors.append(float((torch.sigmoid(logits).detach() - torch.tensor(TRUE)).abs().max()))
    return errors


def compare(
    variant: str, *, size: int = SIZE, steps: int = 120, seeds: int = 3, samples: int = 1024
) -> dict[tuple[str, str], list[list[float]]]:
    """Errors of the reflectance by loss and method (``noisy``, ``denoised``), for each noise seed and step."""
    box = Box(variant, size)
    target = box.plain(torch.tensor(TRUE), samples, seed=12345)
    denoiser = Denoiser("wild_small", differentiable=True)
    found: dict[tuple[str, str], list[list[float]]] = {}
    for loss in LOSSES:
        for method in METHODS[loss]:
            two, used = "two" in method, denoiser if method == "denoised" else None
            count = steps // 2 if two else steps
            runs = found[loss, method] = [
                descend(box, target, loss, used, count, seed, two) for seed in range(1, 1 + seeds)
            ]
            last = [errors[-1] for errors in runs]
            spread = f"{min(last):.3f} to {max(last):.3f}"
            print(f"{loss}, {method}: error {sum(last) / seeds:.3f} ({spread}), {steps} samples")
    return found


def plot(found: dict[tuple[str, str], list[list[float]]], path: Path) -> None:
    """Plot the error over samples per pixel, with a panel for each loss."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, len(LOSSES), figsize=(9, 3.6), sharey=True, layout="constrained")
    for panel, loss in zip(panels, LOSSES, strict=True):
        for color, method in zip(("tab:orange", "tab:green", "tab:blue"), METHODS["relative squared"], strict=True):
            for index, errors in enumerate(found.get((loss, method), [])):
                samples = [step * (2 if "two" in method else 1) for step in range(len(errors))]
                panel.semilogy(samples, errors, color=color, alpha=0.7, label=method if index == 0 else None)
        panel.set(title=f"loss: {loss}", xlabel="samples per pixel")
        panel.legend()
    panels[0].set_ylabel("maximum error of the reflectance")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("inverse_rendering.png"))
    parser.add_argument("--variant", help="Mitsuba variant; by default llvm_ad_rgb if it works, else scalar_rgb")
    parser.add_argument("--size", type=int, default=SIZE)
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--seeds", type=int, default=3, help="number of noise seeds")
    options = parser.parse_args()
    variant = options.variant or first_working(("llvm_ad_rgb",)) or "scalar_rgb"
    print(f"Mitsuba variant {variant}")
    plot(compare(variant, size=options.size, steps=options.steps, seeds=options.seeds), options.out)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
