"""Every renderer: which layer is read as which buffer without a flag, and that the values are those of the scene."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pictures import channels_of
from planes import seen_at

from mcdenoise.data import open_sequence

Image = np.ndarray[Any, Any]

# What these are read from is in the page docs/from-your-renderer.md and in tests/golden, which are tested.
NAMED = ("pbrt", "pbrt_2021", "arnold", "renderman", "renderman_rgba", "vray", "redshift", "octane", "falcor")
CAMERA_SPACE = {"pbrt", "pbrt_2021", "renderman", "renderman_rgba", "vray"}
# These renderers store motion in another way than in pixels, previous - current, y down.
SIGNS = {
    "vray": "current - previous, y down, pixels",
    "redshift": "current - previous, y up, pixels",
    "falcor": "previous - current, y down, parts of the image",
}


def pixels(tensor: Any) -> Image:
    result: Image = tensor[0].permute(1, 2, 0).numpy()
    return result


def projected(position: Image, matrix: Any) -> Image:
    """Columns and rows at which a camera sees positions."""
    return np.stack(seen_at(position, matrix[0])[:2], -1)


def center(position: Image) -> Image:
    rows, columns = np.indices(position.shape[:2]) + 0.5
    return np.stack([columns, rows], -1)


@pytest.mark.parametrize("renderer", NAMED)
def test_files_with_names_of_other_renderers_are_read_without_a_flag(
    renderer: str, others: Any, tmp_path: Path
) -> None:
    others.write(renderer, tmp_path)
    sequence = open_sequence(tmp_path)
    assert sequence.numbers == [1, 2, 3]
    assert sequence.color_has_albedo
    said = {row.buffer: row.reading for row in sequence.table}
    # A sign of motion that differs from the usual one gives a warning; nothing else does.
    words = [f"'motion': read as {SIGNS.get(renderer)}, since only so frames match the ones before them"]
    assert list(sequence.warnings) == (words if renderer in SIGNS else [])
    for number in sequence.numbers:
        truth, frame = others.read(number), sequence.frame(number)
        frame.validate()
        hit = truth["hit"]
        np.testing.assert_array_equal(pixels(frame.color), np.maximum(truth["color"], 0))
        np.testing.assert_array_equal(pixels(frame.albedo), truth["albedo"])
        normal = others.to_camera(truth, truth["normal"]) if renderer in CAMERA_SPACE else truth["normal"]
        # Encoding into 0 to 1 and back rounds twice.
        np.testing.assert_allclose(pixels(frame.normal), np.clip(normal, -1, 1), atol=2e-7)
        np.testing.assert_array_equal(np.isfinite(pixels(frame.depth)[..., 0]), hit)
        # pbrt has no depth: it is that of the positions.
        np.testing.assert_allclose(pixels(frame.depth)[hit][:, 0], truth["depth"][hit], rtol=2e-5)
        if frame.alpha is not None:
            np.testing.assert_array_equal(pixels(frame.alpha)[..., 0], truth["alpha"])
        if frame.variance is not None:
            np.testing.assert_allclose(pixels(frame.variance), others.variance(truth["color"]), rtol=1e-6)
        if "position" in sequence.buffers:
            np.testing.assert_allclose(pixels(frame.position)[hit], truth["position"][hit], atol=2e-5)
        if "motion" in sequence.buffers:
            np.testing.assert_allclose(pixels(frame.motion)[hit], truth["motion"][hit], atol=1e-5)
            # Nothing is known of the sky's.
            assert np.isinf(pixels(frame.motion)[~hit]).all()
    if "motion" in sequence.buffers:
        assert said["motion"].startswith(SIGNS.get(renderer, "previous - current, y down, pixels"))


@pytest.mark.parametrize("renderer", ["pbrt", "redshift", "falcor"])
def test_cameras_found_from_positions_lead_where_motion_does(renderer: str, others: Any, tmp_path: Path) -> None:
    others.write(renderer, tmp_path)
    sequence = open_sequence(tmp_path)
    frames = [sequence.frame(number) for number in sequence.numbers]
    for number, before, now in zip(sequence.numbers[1:], frames[:-1], frames[1:], strict=True):
        truth = others.read(number)
        # The floor stands still; the object above it does not.
        still = truth["hit"] & (np.abs(truth["position"][..., 2]) < 1e-5)
        position = pixels(now.position)
        here, there = projected(position, now.view_projection), projected(position, before.view_projection)
        np.testing.assert_allclose(here[truth["hit"]], center(position)[truth["hit"]], atol=1e-3)
        np.testing.assert_allclose((there - here)[still], truth["motion"][still], atol=2e-3)


def layer(path: Path, name: str, components: str) -> Image:
    channels = channels_of(path)
    return np.stack([channels[f"{name}.{each}" if name else each] for each in components], -1).astype(np.float32)


@pytest.mark.parametrize("number", [1, 4])
def test_the_values_of_blender(number: int, rendered: Path) -> None:
    frame = open_sequence(rendered / "blender").frame(number)
    path = rendered / "blender" / f"shot_{number:04d}.exr"
    vector = layer(path, "ViewLayer.Vector", "XY")
    hit = layer(path, "ViewLayer.Depth", "Z")[..., 0] < 1e9
    np.testing.assert_array_equal(pixels(frame.motion)[hit], vector[hit] * (1, -1))
    assert np.isinf(pixels(frame.motion)[~hit]).all()
    np.testing.assert_array_equal(pixels(frame.depth)[hit], layer(path, "ViewLayer.Depth", "Z")[hit])
    np.testing.assert_array_equal(pixels(frame.normal), layer(path, "ViewLayer.Denoising Normal", "XYZ").clip(-1, 1))
    np.testing.assert_array_equal(pixels(frame.albedo), layer(path, "ViewLayer.Denoising Albedo", "RGB").clip(0, 1))
    np.testing.assert_array_equal(pixels(frame.position)[hit], layer(path, "ViewLayer.Position", "XYZ")[hit])
    # The sky is so far away that it moves with the camera's turning alone, and is seen where it is.
    position = pixels(frame.position)
    np.testing.assert_allclose(projected(position, frame.view_projection), center(position), atol=2e-3)
