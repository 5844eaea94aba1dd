from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mcdenoise.data import read_exr, write_exr
from mcdenoise.data.color_space import to_rec709
from mcdenoise.errors import InputError

ACESCG = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)


def test_what_is_rec709_or_says_nothing_stays() -> None:
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


def test_the_attribute_comes_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "wide.exr"
    write_exr(path, np.full((2, 3, 3), 0.5), ["R", "G", "B"], metadata={"chromaticities": ACESCG})
    metadata = read_exr(path)[2]
    one = torch.tensor([1.0, 0.0, 0.0]).reshape(1, 3, 1, 1)
    torch.testing.assert_close(to_rec709(one, metadata), to_rec709(one, {"chromaticities": ACESCG}))


@pytest.mark.parametrize("stored", ["wide", (0.64, 0.33), (0.3,) * 8, (0.0,) * 8, (float("nan"),) * 8], ids=str)
def test_what_is_no_color_space(stored: Any) -> None:
    with pytest.raises(InputError, match="'chromaticities': expected x and y of red, green, blue and white, found"):
        to_rec709(torch.rand(1, 3, 2, 2), {"chromaticities": stored})
