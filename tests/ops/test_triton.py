"""The Triton kernels: interpreted in a process of their own, and compiled for GPUs that need not be there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from reference_cases import by

from mcdenoise import ops

HERE = Path(__file__).parent
# Two halves, that they may run side by side: the interpreter takes a second for each call, and seconds to start.
PARTS = ["test_result", "not test_result"]


def run(*arguments: str, **variables: str) -> None:
    result = subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTEST_ADDOPTS": ""} | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize("cases", ["not slow", pytest.param("slow", marks=pytest.mark.slow)])
@pytest.mark.parametrize("part", [PARTS[0], pytest.param(PARTS[1], marks=pytest.mark.slow)])
def test_the_interpreted_kernels_are_the_reference(part: str, cases: str) -> None:
    pytest.importorskip("triton", reason="the form for GPUs is in the extra mcdenoise[gpu]")
    arguments = ("-q", "-p", "no:cacheprovider", "-p", "no:xdist", str(HERE / "interpreted.py"))
    run("-m", "pytest", *arguments, "-k", part, "-m", cases, TRITON_INTERPRET="1")


# The oldest that each dtype is used on, and a newer one. The interpreter knows nothing of types that a GPU has not, of
# what may change in a loop, or of names that are missing in its libraries; the compiler does.
@pytest.mark.parametrize(
    ("capability", "dtype"),
    [
        *(
            pytest.param(*pair, marks=pytest.mark.slow)
            for pair in ((75, "float16"), (90, "float32"), (80, "bfloat16"), (90, "float64"), (100, "float32"))
        ),
    ],
)
def test_the_kernels_compile_for(capability: int, dtype: str, tmp_path: Path) -> None:
    pytest.importorskip("triton", reason="the form for GPUs is in the extra mcdenoise[gpu]")
    run(str(HERE / "compile_kernels.py"), str(capability), dtype, TRITON_CACHE_DIR=str(tmp_path), TRITON_INTERPRET="0")


def test_it_says_why_it_cannot_run() -> None:
    image, kernel = torch.rand(1, 3, 4, 5), torch.rand(1, 9, 4, 5)
    for function in (ops.kernel_conv, ops.kernel_splat, ops.cross_bilateral_filter):
        with pytest.raises(ValueError, match="found 'triton', which runs on an NVIDIA GPU, not on cpu"):
            by("triton", function)(image, kernel)
    with pytest.raises(ValueError, match="found 'triton', which has no form of this op"):
        by("triton", ops.downsample)(image)
