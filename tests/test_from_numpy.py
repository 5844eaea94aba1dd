"""Arrays in, an array out: what `Frame.from_numpy` and `denoise` take, in which layout, and what they refuse."""

import re
from typing import Any, get_args

import numpy as np
import pytest
import torch
from refusals import refused

from mcdenoise import Denoiser, Frame, denoise
from mcdenoise.frame import BUFFERS, Layout

HEIGHT, WIDTH = 5, 7
MODEL = "wild_small"
# Accumulated adds these buffers to a frame: no renderer writes them.
OWN = {"current", "recent", "length"}


def image(channels: int, layout: Layout = "HWC", *, seed: int = 0, dtype: Any = np.float32) -> np.ndarray[Any, Any]:
    """The same pixels in either layout."""
    pixels = np.random.default_rng(seed).random((HEIGHT, WIDTH, channels)).astype(dtype)
    return pixels if layout == "HWC" else np.ascontiguousarray(np.moveaxis(pixels, -1, 0))


@pytest.mark.parametrize("layout", get_args(Layout))
def test_every_buffer_of_a_renderer_arrives_in_its_place(layout: Layout) -> None:
    names = [name for name in BUFFERS if name not in OWN]
    arrays = {name: image(BUFFERS[name].channels, layout, seed=seed) for seed, name in enumerate(names)}
    matrix = np.arange(16.0).reshape(4, 4)
    samples = np.stack([image(5, layout, seed=seed) for seed in (50, 51)])
    extra = {"crypto": image(2, layout, seed=60), "matte": image(1, seed=61)[..., 0]}
    frame = Frame.from_numpy(**arrays, layout=layout, view_projection=matrix, samples=samples, extra=extra)
    assert frame.buffers == {*names, "view_projection", "samples", "crypto", "matte"}
    for seed, name in enumerate(names):
        tensor = frame.buffer(name)
        assert tensor.shape == (1, BUFFERS[name].channels, HEIGHT, WIDTH)
        pixels = image(BUFFERS[name].channels, seed=seed)
        assert torch.equal(tensor[0].permute(1, 2, 0), torch.from_numpy(pixels)), name
    assert torch.equal(frame.view_projection[0], torch.from_numpy(matrix))
    assert torch.equal(frame.samples[0, 1].permute(1, 2, 0), torch.from_numpy(image(5, seed=51)))
    assert torch.equal(frame.extra["crypto"][0].permute(1, 2, 0), torch.from_numpy(image(2, seed=60)))
    assert frame.extra["matte"].shape == (1, 1, HEIGHT, WIDTH)


@pytest.mark.parametrize(
    ("dtype", "kept"),
    [
        (np.float16, torch.float16),
        (np.float32, torch.float32),
        (np.float64, torch.float64),
        (np.longdouble, torch.float64),
        (">f4", torch.float32),
        ("<f8", torch.float64),
    ],
)
def test_any_float_dtype(dtype: Any, kept: torch.dtype) -> None:
    pixels = image(3, dtype=dtype)
    frame = Frame.from_numpy(pixels)
    assert frame.color.dtype == kept
    assert np.array_equal(frame.color[0].permute(1, 2, 0).numpy(), pixels)


def read_only(pixels: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    copied = pixels.copy()
    copied.flags.writeable = False
    return copied


def unaligned(pixels: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """A field of records of 5 bytes."""
    records = np.zeros(pixels.shape, dtype=[("flag", "u1"), ("value", "<f4")])
    records["value"] = pixels
    return records["value"]


@pytest.mark.parametrize(
    "view",
    [
        read_only,
        unaligned,
        lambda pixels: pixels[::-1, ::-1].copy()[::-1, ::-1],
        lambda pixels: np.asfortranarray(pixels),
        lambda pixels: np.repeat(pixels, 2, axis=1)[:, ::2],
        lambda pixels: np.concatenate([pixels, pixels], axis=2)[..., :3],
    ],
    ids=["read-only", "unaligned", "negative strides", "Fortran order", "every other", "of RGBRGB"],
)
def test_arrays_of_any_memory(view: Any) -> None:
    pixels = image(3)
    given = view(pixels)
    frame = Frame.from_numpy(given, albedo=given)
    assert torch.equal(frame.color[0].permute(1, 2, 0), torch.from_numpy(pixels))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("color", image(3, "CHW"), "expected shape (H, W, 3), found (3, 5, 7); pass layout='CHW'"),
        ("color", image(4), "expected shape (H, W, 3), found (5, 7, 4); pass its first three channels"),
        ("color", image(2), "expected shape (H, W, 3), found (5, 7, 2)"),
        ("color", image(3)[None], "expected shape (H, W, 3), found (1, 5, 7, 3); pass one image, or tensors"),
        ("color", image(3)[:0], "expected shape (H, W, 3), found (0, 7, 3)"),
        ("color", np.uint8(image(3)), "found uint8; undo the encoding of a display first, about (x / 255)"),
        ("color", np.uint16(image(3)), "found uint16; undo the encoding of a display first, about (x / 65535)"),
        ("color", np.int32(image(3)), "found int32; convert it with astype(numpy.float32)"),
        ("color", image(3) + 1j, "found complex64"),
        ("color", torch.ones(5, 7, 3), "expected a numpy array, found a torch.Tensor"),
        ("color", [[1.0], [1.0, 2.0]], "expected an array, found list"),
        ("color", "image.exr", "expected a float dtype"),
        ("albedo", image(3)[1:], "expected shape (5, 7, 3) like 'color', found (4, 7, 3)"),
        ("albedo", image(3, "CHW"), "expected shape (5, 7, 3) like 'color', found (3, 5, 7)"),
        ("normal", image(4), "expected shape (5, 7, 3) like 'color', found (5, 7, 4)"),
        ("normal", image(1)[..., 0], "expected shape (5, 7, 3) like 'color', found (5, 7)"),
        ("depth", image(3), "expected shape (5, 7, 1) or (5, 7) like 'color', found (5, 7, 3)"),
        ("depth", image(1)[:, 1:, 0], "expected shape (5, 7, 1) or (5, 7) like 'color', found (5, 6)"),
        ("samples", image(3), "expected shape (S, 5, 7, C) like 'color', found (5, 7, 3)"),
        ("view_projection", np.eye(3), "expected shape (4, 4), found (3, 3)"),
        ("view_projection", np.eye(4)[None], "expected shape (4, 4), found (1, 4, 4)"),
        ("depth", image(1).astype(bool), "expected a float dtype"),
    ],
)
def test_arrays_that_do_not_fit_are_refused_in_one_line(name: str, value: Any, message: str) -> None:
    for function in (Frame.from_numpy, denoise):
        told = refused(function, **{"color": image(3), name: value})
        assert told.startswith(f"buffer '{name}': ")
        assert message in told


def test_names_and_layouts_that_are_none() -> None:
    for color, message in (
        (image(3), "found (5, 7, 3); pass layout='HWC'"),
        (image(4, "CHW"), "its first three channels"),
    ):
        told = refused(denoise, color, layout="CHW")
        assert told.startswith("buffer 'color': expected shape (3, H, W), ")
        assert message in told
    assert re.search(r"layout: .*'NHWC'", refused(Frame.from_numpy, image(3), layout="NHWC"))
    assert "buffer 'normals'" in refused(Frame.from_numpy, image(3), normals=image(3))
    assert re.search(r"extra: .*'albedo'", refused(Frame.from_numpy, image(3), extra={"albedo": image(3)}))
    assert "buffer 'crypto'" in refused(Frame.from_numpy, image(3), extra={"crypto": image(2)[1:]})


@pytest.mark.parametrize(
    ("name", "model", "near"),
    [
        ("normals", None, "normal"),
        ("normals", "noisy", "normal"),
        ("normals", lambda color: color, "normal"),
        ("wieghts", None, "weights"),
        ("layuot", None, "layout"),
        ("alpha_mni", MODEL, "alpha_min or alpha"),
    ],
)
def test_a_misspelt_argument_is_named_without_its_value(name: str, model: Any, near: str) -> None:
    message = refused(denoise, image(3), model=model, **{name: image(3)})
    assert message.startswith(f"argument '{name}': expected a buffer or an argument of Denoiser")
    assert message.endswith(f", found none of this name; did you mean {near}?")
    assert "0." not in message


def test_a_warning_shows_the_line_of_the_caller() -> None:
    albedo = image(3)
    albedo[0, 0] = 3
    for function in (
        lambda: denoise(image(3), albedo=albedo, model="noisy"),
        Frame.from_numpy(image(3), albedo=albedo).validate,
    ):
        with pytest.warns(UserWarning, match="buffer 'albedo'") as caught:
            function()
        assert [each.filename for each in caught] == [__file__]


@pytest.mark.parametrize(("layout", "dtype"), [("HWC", np.float16), ("CHW", np.float64)])
def test_a_still_is_what_the_denoiser_makes_of_it(layout: Layout, dtype: Any) -> None:
    color, albedo, normal = (image(3, layout, seed=seed, dtype=dtype) for seed in range(3))
    depth = image(1, layout, seed=3, dtype=dtype)
    before = color.copy()
    clean = denoise(color, albedo=albedo, normal=normal, depth=depth, layout=layout, model=MODEL)
    assert np.array_equal(color, before)
    assert clean.shape == color.shape
    assert clean.dtype == np.float32
    assert clean.flags.c_contiguous
    assert clean.flags.writeable
    axes = (2, 0, 1) if layout == "HWC" else (0, 1, 2)
    tensors = [torch.from_numpy(each.transpose(axes).copy())[None] for each in (color, albedo, normal, depth)]
    denoiser = Denoiser(MODEL)
    denoiser.reset(frames=1)
    color_, albedo_, normal_, depth_ = tensors
    expected = denoiser(Frame(color_, albedo=albedo_, normal=normal_, depth=depth_))[0].permute(
        np.argsort(axes).tolist()
    )
    assert np.array_equal(clean, expected.numpy())
