"""Single samples of pixels from files: layers of an EXR whose mean is its color."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import succeeds
from pictures import as_channels, save

from mcdenoise.data import open_sequence, write_exr
from mcdenoise.data.readers.bmfr import write_bmfr_frame
from mcdenoise.data.readers.samples import write_samples
from mcdenoise.frame import Frame

COUNT, SIZE = 3, (12, 16)
Image = np.ndarray[Any, Any]


def drawn(channels: int = 3) -> Image:
    """Samples ``(S, C, H, W)``, some of them dark and few bright, as those of one path a pixel are."""
    g = np.random.default_rng(7)
    light = g.exponential(1, (COUNT, 3, *SIZE)) * (g.random((COUNT, 1, *SIZE)) < 0.5)
    return np.concatenate([light, g.random((COUNT, channels - 3, *SIZE))], 1).astype(np.float32)


def picture(samples: Image) -> Image:
    mean: Image = samples[:, :3].mean(0).transpose(1, 2, 0)
    return mean


def in_color(samples: Image) -> dict[str, Image]:
    return as_channels({"": picture(samples)} | {f"sample{k}": s.transpose(1, 2, 0) for k, s in enumerate(samples)})


@pytest.mark.parametrize("kind", ["float", "half"])
def test_layers_beside_the_color(tmp_path: Path, kind: str) -> None:
    samples = drawn()
    sequence = open_sequence(save(tmp_path / "shot_0001.exr", in_color(samples), kind))
    assert "samples" in sequence.buffers
    assert not sequence.warnings
    frame = sequence.frame(1)
    np.testing.assert_allclose(frame.samples[0], samples, rtol=2.0**-11 if kind == "half" else 0)
    assert sequence.frame(1, buffers={"albedo"}).samples is None


@pytest.mark.parametrize("channels", [3, 10])
@pytest.mark.parametrize("layout", ["files", "bmfr"])
def test_a_file_of_their_own_comes_back(tmp_path: Path, channels: int, layout: str) -> None:
    samples = drawn(channels)
    if layout == "files":
        write_exr(tmp_path / "color_0004.exr", picture(samples), ["R", "G", "B"], full_float=True)
        write_samples(tmp_path / "samples_0004.exr", samples)
    else:
        color = torch.from_numpy(picture(samples)).permute(2, 0, 1)[None]
        write_bmfr_frame(tmp_path, 4, Frame(color=color, samples=torch.from_numpy(samples)[None]))
    sequence = open_sequence(tmp_path)
    assert (sequence.layout, sequence.unused, sequence.warnings) == (layout, [], [])
    frame = sequence.frame(4)
    np.testing.assert_allclose(frame.samples[0], samples, rtol=2.0**-11, atol=2.0**-25)
    assert sequence.frame(4, buffers=()).samples is None


@pytest.mark.parametrize("layout", ["files", "bmfr"])
def test_samples_whose_mean_is_not_the_color_are_not_used(tmp_path: Path, layout: str) -> None:
    samples = drawn()
    name = "color_0004.exr" if layout == "files" else "color4.exr"
    write_exr(tmp_path / name, 1.02 * picture(samples), ["R", "G", "B"], full_float=True)
    write_samples(tmp_path / name.replace("color", "samples"), samples)
    if layout == "bmfr":
        (tmp_path / "camera.json").write_text('{"color_includes_albedo": true}')
    sequence = open_sequence(tmp_path)
    assert sequence.layout == layout
    (warning,) = sequence.warnings
    assert warning.startswith("'samples': ")
    assert "is not the color: not used" in warning
    assert "samples" not in sequence.buffers
    assert sequence.frame(4).samples is None


@pytest.mark.parametrize("model", ["sbmc", "layered"])
def test_methods_of_samples_run_on_those_of_files(tmp_path: Path, model: str) -> None:
    samples = drawn()
    for number in (1, 2):
        save(tmp_path / "in" / f"shot_000{number}.exr", in_color(samples))
    printed = succeeds("denoise", tmp_path / "in", "-o", tmp_path / "out", "--model", model)
    assert f"  samples: kept ({COUNT} of each pixel, and the history)\n" in printed
    assert "samples: of use to anf, layered, nppd, sbmc\n" in succeeds("inspect", tmp_path / "in")
