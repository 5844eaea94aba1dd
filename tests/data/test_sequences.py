import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from planes import seen_at
from refusals import refused

from mcdenoise.data import open_sequence, read_exr, write_exr
from mcdenoise.data.camera_matrices import CameraMatrices, read_camera_matrices, write_camera_matrices
from mcdenoise.data.readers.bmfr import noise_seed_folder, write_bmfr_frame
from mcdenoise.data.sequences import parse_frames

RGB = ["R", "G", "B"]


def pixel_index(position: torch.Tensor, matrix: torch.Tensor) -> torch.Tensor:
    """(row, column) of every world position, written out as in the file format's description."""
    column, row, _ = seen_at(position.permute(1, 2, 0).numpy(), matrix)
    return torch.from_numpy(np.stack([row, column])) - 0.5


def pixel_centres(height: int, width: int) -> torch.Tensor:
    return torch.stack(torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")).double()


def test_properties_of_a_sequence(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    assert (sequence.root, sequence.name, sequence.layout) == (small_sequence, "plane", "bmfr")
    assert (sequence.numbers, sequence.size, len(sequence)) == ([0, 1, 2, 3], (20, 24), 4)
    names = {"color", "albedo", "normal", "position", "depth", "reference", "view_projection"}
    assert sequence.buffers == names
    assert sequence.reference_numbers == [0, 1, 2, 3]
    assert sequence.color_has_albedo
    assert {name for name, _ in sequence.frame(0).items()} == names
    assert sequence.frame(0, reference=False).reference is None


def test_convention_position_projects_to_its_pixel_centre(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    for number in sequence.numbers:
        frame = sequence.frame(number)
        index = pixel_index(frame.position[0], frame.view_projection[0])
        assert (index - pixel_centres(*sequence.size)).abs().max() < 1e-3


@pytest.mark.parametrize(("offset_x", "offset_y"), [(0.5, 0.5), (0.25, 0.5), (0.5, 0.9), (0.1, 0.3)])
def test_pixel_offsets_are_folded_into_the_matrix(small_sequence: Path, offset_x: float, offset_y: float) -> None:
    path = small_sequence / "inputs" / "camera_matrices.h"
    cameras = read_camera_matrices(path)
    position = open_sequence(small_sequence).frame(1).position[0]
    shifted = CameraMatrices(cameras.matrices, np.tile([offset_x, offset_y], (4, 1)))
    write_camera_matrices(path, shifted)
    # The format says: pixel index = (u W - ox, v H - (1 - oy)), with the matrix as it stands in the file.
    plain = pixel_index(position, torch.from_numpy(cameras.matrices[1]))
    expected = plain + 0.5 - torch.tensor([1 - offset_y, offset_x])[:, None, None]
    found = pixel_index(position, open_sequence(small_sequence).frame(1).view_projection[0])
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


def test_convention_depth_is_infinite_only_where_nothing_was_hit(small_sequence: Path) -> None:
    for with_file in (True, False):
        frame = open_sequence(small_sequence).frame(0)
        sky = (frame.normal == 0).all(dim=1, keepdim=True)
        mirror = (frame.albedo == 0).all(dim=1, keepdim=True) & ~sky
        assert sky.any(), with_file
        assert mirror.any()
        assert torch.equal(frame.depth.isinf(), sky)
        for path in (small_sequence / "inputs").glob("depth*.exr"):
            path.unlink()


def test_published_data_gets_its_albedo_back(small_sequence: Path) -> None:
    expected = open_sequence(small_sequence).frame(1)
    inputs = small_sequence / "inputs"
    for number in range(4):
        color, albedo = (read_exr(inputs / f"{name}{number}.exr")[0] for name in ("color", "albedo"))
        write_exr(inputs / f"color{number}.exr", color / np.maximum(albedo, 1e-3), RGB, full_float=True)
    for content in (None, {"color_includes_albedo": False}):
        (inputs / "camera.json").unlink()
        if content is not None:
            (inputs / "camera.json").write_text(json.dumps(content))
        sequence = open_sequence(small_sequence)
        assert not sequence.color_has_albedo
        found = sequence.frame(1).color
        somewhere = (expected.albedo > 0).expand_as(found)
        torch.testing.assert_close(found[somewhere], expected.color[somewhere], rtol=1e-3, atol=0)
        (inputs / "camera.json").write_text("{}")


def _add_noise_seed(inputs: Path, noise_seed: int, numbers: range) -> None:
    for number in numbers:
        color = np.full((20, 24, 3), 10.0 * noise_seed + number)
        folder = noise_seed_folder(inputs, noise_seed)
        folder.mkdir(exist_ok=True)
        write_exr(folder / f"color{number}.exr", color, RGB)


def test_noise_seeds_of_the_noise(small_sequence: Path) -> None:
    inputs = small_sequence / "inputs"
    assert open_sequence(small_sequence).noise_seeds == 1
    _add_noise_seed(inputs, 1, range(4))
    _add_noise_seed(inputs, 2, range(2))
    _add_noise_seed(inputs, 4, range(4))
    sequence = open_sequence(small_sequence)
    # The second one is not complete, and what comes after a gap does not count.
    assert sequence.noise_seeds == 2
    assert open_sequence(small_sequence, "0-1").noise_seeds == 3
    first, second = sequence.frame(3), sequence.frame(3, noise_seed=1)
    assert second.color.unique().tolist() == [13]
    for name, value in first.items():
        assert name == "color" or torch.equal(value, getattr(second, name))
    assert sequence.frame(3, reference=False, noise_seed=1).reference is None
    for wrong in (2, -1):
        message = refused(lambda wrong=wrong: sequence.frame(0, noise_seed=wrong))
        assert f"expected a noise seed from 0 to 1, found {wrong}" in message


@pytest.mark.parametrize(
    ("text", "expected"),
    [("0", [0]), ("0-3", [0, 1, 2, 3]), ("0-1,70", [0, 1, 70]), (" 5 , 3 - 4,3 ", [3, 4, 5]), ("007", [7])],
)
def test_parse_frames(text: str, expected: list[int]) -> None:
    assert parse_frames(text) == expected


@pytest.mark.parametrize(
    "text", ["", ",", "a", "-1", "3-1", "1-", "0--1", "0-999999999", "1" * 5000, "0-600000,600001-1200000", "٣", "1.5"]
)
def test_parse_frames_refuses(text: str) -> None:
    assert "frames: expected" in refused(lambda: parse_frames(text))


def _rewrite(path: Path, change: Callable[[np.ndarray], np.ndarray], channels: list[str]) -> None:
    write_exr(path, change(read_exr(path)[0]), channels)


def _no_matrix_for_the_last_frame(inputs: Path) -> None:
    cameras = read_camera_matrices(inputs / "camera_matrices.h")
    fewer = CameraMatrices(cameras.matrices[:3], cameras.pixel_offsets[:3])
    write_camera_matrices(inputs / "camera_matrices.h", fewer)


def _without_albedo(inputs: Path) -> None:
    for path in inputs.glob("albedo*.exr"):
        path.unlink()
    (inputs / "camera.json").write_text('{"color_includes_albedo": false}')


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "buffer of one frame": (
        lambda inputs: (inputs / "shading_normal2.exr").unlink(),
        r"shading_normal#\.exr: expected buffer 'normal'.*frame 2",
    ),
    "size of one buffer": (
        lambda inputs: _rewrite(inputs / "albedo1.exr", lambda image: image[1:], RGB),
        r"albedo1\.exr: expected 24 x 20 pixels.*found 24 x 19",
    ),
    "size of one frame": (
        lambda inputs: _rewrite(inputs / "color2.exr", lambda image: image[:, 1:], RGB),
        r"color2\.exr: expected 24 x 20 pixels.*found 23 x 20",
    ),
    "size of a reference": (
        lambda inputs: _rewrite(inputs / "reference1.exr", lambda image: image[1:], RGB),
        r"reference1\.exr: expected 24 x 20",
    ),
    "depth in three channels": (
        lambda inputs: _rewrite(inputs / "depth0.exr", lambda image: image.repeat(3, axis=2), RGB),
        r"depth1\.exr: expected channel 'R'",
    ),
    "too few matrices": (_no_matrix_for_the_last_frame, "expected a matrix for frame 3, found 3"),
    "no EXR": (lambda inputs: (inputs / "albedo3.exr").write_bytes(b"hello"), r"albedo3\.exr: expected an image"),
    "twice": (
        lambda inputs: shutil.copy(inputs / "color1.exr", inputs / "color01.exr"),
        r"found color01\.exr and color1\.exr",
    ),
    "camera.json cut short": (lambda inputs: (inputs / "camera.json").write_text('{"a'), "expected a JSON object"),
    "camera.json no object": (lambda inputs: (inputs / "camera.json").write_text("[1]"), "expected a JSON object"),
    "camera.json unclear": (
        lambda inputs: (inputs / "camera.json").write_text('{"color_includes_albedo": "yes"}'),
        "is true or false, found: 'yes'",
    ),
    "albedo to multiply is missing": (_without_albedo, "expected albedo files"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_sequence_is_refused_in_one_line(small_sequence: Path, case: str) -> None:
    change, pattern = BROKEN[case]
    change(small_sequence / "inputs")
    before = sorted(small_sequence.rglob("*"))
    message = refused(lambda: open_sequence(small_sequence))
    assert re.search(pattern, message), message
    assert str(small_sequence) in message
    assert sorted(small_sequence.rglob("*")) == before


HEADER = """
// const float camera_matrices[9][4][4] = { nonsense };
const float position_limit_squared = 0.0016f; /* scene units;
squared */ const float normal_limit_squared=.25;
static const float camera_matrices[1][4][4] = { // first
  {{1.2f, -3e-10f, 5, 0.f}, {+1, 2., -.5F, 1e2}, {0,0,1,0,}, {0.0f, 1.0f, 2E-1f, 1}},
};
const float pixel_offsets[1][2] = {{0.5f, /* y */ 0.25f}};
"""


def test_camera_header_is_read_as_c(tmp_path: Path) -> None:
    path = tmp_path / "camera_matrices.h"
    path.write_text(HEADER)
    cameras = read_camera_matrices(path)
    expected = [[1.2, -3e-10, 5, 0], [1, 2, -0.5, 100], [0, 0, 1, 0], [0, 1, 0.2, 1]]
    assert cameras.matrices.dtype == np.float64
    assert cameras.matrices.tolist() == [expected]
    assert cameras.pixel_offsets.tolist() == [[0.5, 0.25]]
    # What only others read is written, and need not be there.
    write_camera_matrices(path, cameras, position_limit_squared=0.0016)
    assert "const float position_limit_squared = 0.0016f;" in path.read_text()
    assert read_camera_matrices(path).pixel_offsets.tolist() == [[0.5, 0.25]]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("1.2f", "nan"),
        ("1.2f", "1e39f"),
        ("1.2f", "sqrt(2)"),
        ("1.2f, ", ""),
        ("0.5f", "FLT_MAX"),
        ("{{0.5f, /* y */ 0.25f}}", "{{0.5f, 0.25f}, {0.5f, 0.25f}}"),
        ("{{0.5f, /* y */ 0.25f}}", "{" * 100_000 + "}" * 100_000),
        ("pixel_offsets", "pixel_offset"),
        ("/* y */", "/* y"),
        ("};\n", ""),
    ],
)
def test_malformed_camera_header_is_refused(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "camera_matrices.h"
    assert old in HEADER
    path.write_text(HEADER.replace(old, new))
    assert str(path) in refused(lambda: read_camera_matrices(path))


def test_written_frame_is_read_back(small_sequence: Path, tmp_path: Path) -> None:
    frame = open_sequence(small_sequence).frame(1)
    frame = frame.replace(motion=torch.randn(1, 2, 20, 24, generator=torch.Generator().manual_seed(0)).half().float())
    # These positions are not rounded to half floats.
    frame = frame.replace(previous_position=frame.position + 1e-3)
    write_bmfr_frame(tmp_path / "new", 0, frame)
    sequence = open_sequence(tmp_path / "new")
    assert not [path for path in (tmp_path / "new").iterdir() if path.name.startswith(".")]
    found = sequence.frame(0)
    for name, value in frame.items():
        if name != "view_projection":
            torch.testing.assert_close(getattr(found, name), value, rtol=0, atol=0, msg=name)


def test_motion_of_three_channels_is_that_of_the_first_two(small_sequence: Path) -> None:
    inputs = small_sequence / "inputs"
    (inputs / "camera_matrices.h").unlink()
    for number in range(4):
        write_exr(inputs / f"motion{number}.exr", np.tile(np.float32([0.25, 0, 7]), (20, 24, 1)), RGB)
    motion = open_sequence(small_sequence).frame(1).motion
    assert motion.shape == (1, 2, 20, 24)
    assert motion.abs().amax(dim=(0, 2, 3)).tolist() == [0.25, 0]
