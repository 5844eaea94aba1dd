"""Small wrong edits of the ops and of what models are made of, each of which the checks must notice."""

from typing import NamedTuple


class Mutant(NamedTuple):
    """A wrong edit.

    Args:
        target: the op whose checks must fail; or a model, as ``model:NAME``.
        file: below ``mcdenoise/``.
        right: text that is in the file exactly once.
        wrong: what takes its place.
    """

    target: str
    file: str
    right: str
    wrong: str

    @property
    def name(self) -> str:
        """Target and edit in one line."""
        return f"{self.target}: {self.right} -> {self.wrong or 'nothing'}"


_MODEL = "model:wild_small"
_MOTION, _LAG = "motion_from_position", "history_lag"

MUTANTS = tuple(
    Mutant(*each)
    for each in (
        # Borders, windows and half pixels.
        ("kernel_conv", "ops/kernel_conv.py", "torch.where(mask, kernel, 0).sum(1", "kernel.sum(1"),
        ("kernel_splat", "ops/_window.py", "tap // kernel_size - radius, tap", "radius - tap // kernel_size, tap"),
        ("kernel_splat", "ops/_window.py", "F.pad(before, first)", "F.pad(before, last)"),
        ("upsample", "ops/fusion.py", 'mode="nearest"', 'mode="bilinear"'),
        (_LAG, "ops/lag.py", "(radius, 0), count_include_pad=False", "(radius, 0), count_include_pad=True"),
        (_MOTION, "ops/temporal.py", "device, dtype) + 0.5", "device, dtype)"),
        ("reproject", "ops/temporal.py", "(x < width)", "(x <= width)"),
        ("grid_splat", "ops/bilateral_grid.py", "(0.5 / GUIDE_STEPS * bins - 0.5)", "(0.5 / GUIDE_STEPS * bins)"),
        ("learned_upsample", "ops/partition.py", "side // 2 - 1\n", "side // 2\n"),
        ("temporal_gradient", "ops/gradients.py", "arange(stratum // 2, size + stratum // 2", "arange(0, size"),
        # Missing cases: no weight, black, nothing hit, NaN beyond an edge.
        (
            "kernel_conv",
            "ops/kernel_conv.py",
            "torch.where(empty, 0, values / torch.where(empty, 1, total))",
            "values / total",
        ),
        (
            "demodulate",
            "ops/demodulation.py",
            "torch.where(textured, albedo.clamp_min(floor), 1)",
            "albedo.clamp_min(floor)",
        ),
        ("clamp_fireflies", "ops/fireflies.py", "(brightness > 0)", "(brightness >= 0)"),
        (_MOTION, "ops/temporal.py", "in_front = hit & (w > 0)", "in_front = hit"),
        (_MOTION, "ops/temporal.py", "torch.where(hit, position.to(dtype), 0)", "position.to(dtype)"),
        ("reproject", "ops/temporal.py", "bilinear * torch.where(kept, value, 0)", "bilinear * value"),
        ("grid_splat", "ops/bilateral_grid.py", "torch.where(filled, total[:, -1:], 1)", "total[:, -1:]"),
        ("affinity_filter", "ops/affinity.py", "own.clamp_min(LEAST_CENTER)", "own"),
        # Wrong formulas.
        (
            "laplacian_fusion",
            "ops/fusion.py",
            "coarse.to(dtype) - downsample(source)",
            "downsample(source) - coarse.to(dtype)",
        ),
        ("luminance_moments", "ops/moments.py", "(0.2126, 0.7152, 0.0722)", "(0.2126, 0.0722, 0.7152)"),
        ("moments_variance", "ops/moments.py", "torch.where(difference > 0, difference, 0)", "difference.abs()"),
        ("reproject", "ops/temporal.py", "else position_limit) * depth\n    else", "else position_limit)\n    else"),
        ("accumulate", "ops/temporal.py", "1 / (length + 1)", "1 / length"),
        ("resample", "ops/resampling.py", "torch.maximum(value, least)", "value"),
        (
            "cross_bilateral_weights",
            "ops/bilateral.py",
            "(dy * dy + dx * dx) * spacing",
            "(abs(dy) + abs(dx)) * spacing",
        ),
        ("atrous", "ops/_edges.py", "weight.square() * variance", "weight * variance"),
        ("atrous", "ops/_edges.py", "forward.abs() < backward.abs()", "forward.abs() > backward.abs()"),
        ("temporal_gradient", "ops/gradients.py", "compared * torch.maximum(now, before)", "compared * now"),
        ("block_regression", "ops/regression.py", "block * block * ridge", "block * ridge"),
        # Wrong or missing derivatives.
        ("clamp_fireflies", "ops/fireflies.py", "brightness, 1) * highest", "brightness, 1) * highest.detach()"),
        (
            "pyramid_partition",
            "ops/partition.py",
            "torch.softmax(logits.to(dtype), 1)",
            "torch.softmax(logits.detach().to(dtype), 1)",
        ),
        ("accumulate", "ops/temporal.py", "base.long(), q - base", "base.long(), (q - base).detach()"),
        ("atrous", "ops/atrous.py", "torch.sqrt(blurred(noise)", "torch.sqrt(blurred(noise.detach())"),
        # Range and precision.
        (_LAG, "ops/_numbers.py", "torch.where(largest > 0, power, 1)", "torch.ones_like(largest)"),
        ("temporal_gradient", "ops/_numbers.py", "torch.where(largest > 0, power, 1)", "torch.ones_like(largest)"),
        ("softmax_splat", "ops/softmax_splat.py", "exponents - arriving.reshape(exponents.shape)", "exponents"),
        ("importance_filter", "ops/importance.py", "torch.exp(self.maximum - maximum)", "torch.exp(self.maximum)"),
        ("block_regression", "ops/regression.py", "x - x[:, :1].detach()", "x"),
        (
            "moments_variance",
            "ops/moments.py",
            "first, second = mean.split(1, 1)",
            "first, second = mean.to(moments.dtype).to(mean.dtype).split(1, 1)",
        ),
        # Models.
        (_MODEL, "nn/oidn.py", "torch.where(count > 0, torch.exp2(mean), _LEAST)", "(1 + 0 * mean)"),
        (_MODEL, "ops/_steps/wild.py", "expand(mixed) / exposure", "expand(mixed)"),
        ("model:cascaded", "nn/inputs.py", "torch.where(lit, key / typical, 1)", "torch.where(lit, key, 1)"),
    )
)
