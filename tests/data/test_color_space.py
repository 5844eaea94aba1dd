import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from refusals import refused

from mcdenoise import Denoiser
from mcdenoise.data import open_sequence, read_exr, write_exr
from mcdenoise.data.color_space import to_rec709
from mcdenoise.folder import denoise_sequence
from mcdenoise.metrics import smape_linear

ACESCG = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)


def test_rec709_and_files_without_primaries_are_unchanged() -> None:
    image = torch.rand(1, 3, 4, 5)
    assert to_rec709(image, {}) is image
    assert to_rec709(image, {"chromaticities": REC709}) is image


def test_acescg_is_converted() -> None:
    # Its primaries, in Rec. 709: the published matrix of the Bradford adaptation, and white stays white.
    red, green, blue = torch.eye(3).reshape(3, 3, 1, 1).split(1)
    columns = [to_rec709(x, {"chromaticities": ACESCG}).flatten().tolist() for x in (red, green, blue)]
    expected = [[1.70505, -0.13026, -0.02400], [-0.62179, 1.14080, -0.12897], [-0.08326, -0.01055, 1.15297]]
    np.testing.assert_allclose(columns, expected, atol=2e-5)
    white = torch.ones(2, 3, 4, 5, dtype=torch.float64)
    torch.testing.assert_close(to_rec709(white, {"chromaticities": ACESCG}), white, atol=1e-4, rtol=0)


RED_IS_GREEN = (0.64, 0.33, 0.64, 0.33, 0.15, 0.06, 0.3127, 0.329)


@pytest.mark.parametrize(
    "stored", ["wide", (0.64, 0.33), (0.3,) * 8, (0.0,) * 8, (float("nan"),) * 8, RED_IS_GREEN], ids=str
)
def test_invalid_color_spaces(stored: Any) -> None:
    assert "'chromaticities':" in refused(to_rec709, torch.rand(1, 3, 2, 2), {"chromaticities": stored})


def test_frames_of_acescg_are_denoised_in_it_and_come_back_in_it(
    small_sequence: Path, tmp_path: Path, colour: Any
) -> None:
    """Color and albedo keep the primaries of the file: in Rec. 709, saturated colors would be negative."""
    spaces = colour.RGB_COLOURSPACES
    matrix = colour.matrix_RGB_to_RGB(spaces["sRGB"], spaces["ACEScg"], chromatic_adaptation_transform="Bradford")
    wide = shutil.copytree(small_sequence, tmp_path / "wide")
    for path in [*wide.glob("inputs/color*.exr"), *wide.glob("inputs/albedo*.exr")]:
        pixels, channels, _ = read_exr(path)
        write_exr(path, pixels @ matrix.T, channels, full_float=True, metadata={"chromaticities": ACESCG})
    shown = []
    for root in (small_sequence, wide):
        out = tmp_path / f"clean_{root.name}"
        denoise_sequence(open_sequence(root), out, Denoiser("wild_small"), "wild_small")
        pixels, _, metadata = read_exr(out / "denoised3.exr")
        assert ("chromaticities" in metadata) == (root == wide)
        shown.append(to_rec709(torch.from_numpy(pixels[..., :3]).permute(2, 0, 1)[None], metadata))
    assert metadata["chromaticities"] == pytest.approx(ACESCG)
    # The network sees other numbers, and so gives a slightly different picture: measured 0.008.
    assert float(smape_linear(*shown)) < 0.02
