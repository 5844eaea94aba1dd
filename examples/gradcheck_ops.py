"""Check the derivatives of a filter of your own, and those of the package's operators.

    python examples/gradcheck_ops.py
    python examples/gradcheck_ops.py reproject accumulate

The script composes demodulation, cross-bilateral weights, per-pixel kernel convolution and remodulation into one
function, and compares its first and second derivatives in every input with finite differences in float64, element by
element. Then it runs the package's test cases for these operators, or for the named ones; `mcdenoise gradcheck` runs
them for all operators. The exit status is 1 if a derivative is wrong.
"""

import argparse
import sys

import torch
from torch import Tensor

from mcdenoise.check import gradcheck
from mcdenoise.check.gradients import check_case, select
from mcdenoise.ops import cross_bilateral_weights, demodulate, kernel_conv, remodulate

PARTS = ["demodulate", "cross_bilateral_weights", "kernel_conv", "remodulate"]


def my_filter(
    color: Tensor, albedo: Tensor, normal: Tensor, logits: Tensor, falloff: Tensor, distance_falloff: Tensor
) -> Tensor:
    """Filter the demodulated color with predicted kernels that stop at edges of the normal."""
    light = demodulate(color, albedo)
    weights = cross_bilateral_weights(logits, [normal], [falloff], distance_falloff, border="renormalize")
    return remodulate(kernel_conv(light, weights), albedo)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("ops", nargs="*", metavar="OP", help="operators of the table to check")
    options = parser.parse_args()

    torch.manual_seed(0)
    # Small, because each element of each input is perturbed separately, and odd, because errors at borders show there.
    size = (3, 5)
    inputs = {
        "color": torch.rand(1, 3, *size) * 2,
        "albedo": torch.rand(1, 3, *size) * 0.8 + 0.1,
        "normal": torch.randn(1, 3, *size),
        "logits": torch.randn(1, 9, *size),
        "falloff": torch.rand(1, 1, *size),
        "distance_falloff": torch.rand(1, 1, *size),
    }
    # The check converts the inputs to float64, because finite differences need its precision.
    results = gradcheck(my_filter, *inputs.values())
    results += [check_case(op, case) for op, case in select(options.ops or PARTS)]
    for result in results:
        verdict = "passed" if result.passed else "FAILED"
        print(f"{verdict}  {result.op}, {result.case} case, in {', '.join(result.inputs)}: {result.seconds:.1f} s")
        if not result.passed:
            print(f"        {result.message}")
    return 0 if all(result.passed for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())
