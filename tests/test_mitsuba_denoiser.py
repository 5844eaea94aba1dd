"""The stand-in for `mi.OptixDenoiser`: bitmaps, tensors, gradients, and the meaning of its arguments here."""

import importlib
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from refusals import refused
from test_docs import DOCS, blocks
from torch import Tensor

from mcdenoise import Denoiser, Frame
from mcdenoise.integrations.mitsuba import MitsubaDenoiser
from mcdenoise.scenes.render.loading import LLVM

WIDTH, HEIGHT = 64, 36
MODEL = "wild"
Array = np.ndarray[Any, Any]


@pytest.fixture
def mi() -> Iterator[Any]:
    """Mitsuba in its scalar variant, which runs everywhere."""
    mitsuba = pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install 'mcdenoise[render]'")
    mitsuba.set_variant("scalar_rgb")
    # On a single core, loading a scene waits for a second thread.
    drjit = importlib.import_module("drjit")
    drjit.set_thread_count(max(2, drjit.thread_count()))
    yield mitsuba
    mitsuba.set_variant("scalar_rgb")


def test_threads_of_torch_do_not_spin_beside_those_of_the_renderer() -> None:
    """In a process of its own, since torch is here already."""
    code = "import os, mcdenoise.integrations.mitsuba; print(os.environ['OMP_WAIT_POLICY'])"
    environment = {name: value for name, value in os.environ.items() if name not in ("GOMP_SPINCOUNT", "KMP_BLOCKTIME")}
    environment.pop("OMP_WAIT_POLICY", None)
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "PASSIVE\n"


TRIAL = """
import drjit, mitsuba, torch
mitsuba.set_variant("llvm_ad_rgb")
x = mitsuba.TensorXf([1.0, 2.0], shape=(2, 1))
drjit.enable_grad(x)
drjit.backward(drjit.sum(drjit.wrap(source="drjit", target="torch")(lambda x: x.square())(x)))
assert drjit.grad(x).numpy().ravel().tolist() == [2, 4]
"""


@pytest.fixture(scope="session")
def differentiates() -> str:
    """Return why no variant differentiates here, if none does: an old LLVM aborts a process, so a child tries."""
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install 'mcdenoise[render]'")
    child = subprocess.run([sys.executable, "-c", TRIAL], capture_output=True, text=True, timeout=120, check=False)
    return "" if child.returncode == 0 else LLVM


@pytest.fixture
def ad(mi: Any, differentiates: str) -> Any:
    if differentiates:
        pytest.skip(differentiates)
    mi.set_variant("llvm_ad_rgb")
    return mi


@pytest.fixture
def rendered(mi: Any) -> tuple[Any, Array]:
    """A box at one sample a pixel, as a bitmap of layers, and its reference."""
    box = mi.cornell_box()
    box["sensor"]["film"] |= {"width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}, "pixel_format": "rgba"}
    image = {"type": "path", "max_depth": 4}
    box["integrator"] = {"type": "aov", "aovs": "albedo:albedo,normals:sh_normal", "image": image}
    scene = mi.load_dict(box)
    mi.render(scene, spp=64, seed=1)
    reference = layers(scene.sensors()[0].film().bitmap())["<root>"]
    mi.render(scene, spp=1, seed=2)
    return scene.sensors()[0].film().bitmap(), reference


def layers(bitmap: Any) -> dict[str, Array]:
    return {name: np.array(layer) for name, layer in bitmap.split()}


def noise(channels: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).random((HEIGHT, WIDTH, channels)).astype(np.float32)


def smape(image: Array, reference: Array) -> float:
    return float(np.mean(2 * np.abs(image - reference) / (np.abs(image) + np.abs(reference) + 0.01)))


def test_the_example_of_the_page_runs(mi: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert len((DOCS / "mitsuba.md").read_text(encoding="utf-8").split()) <= 600
    (code,) = blocks("mitsuba.md", "python")
    exec(compile(code, "mitsuba.md", "exec"), {"__name__": "page"})
    clean = np.array(mi.Bitmap("clean.exr"))
    assert clean.shape == (HEIGHT, WIDTH, 3)
    assert np.isfinite(clean).all()


def test_a_bitmap_of_layers_is_denoised_as_its_arrays_are(mi: Any, rendered: tuple[Any, Array]) -> None:
    bitmap, reference = rendered
    before = np.array(bitmap)
    denoiser = MitsubaDenoiser((WIDTH, HEIGHT), albedo=True, normals=True, model=MODEL)
    clean = denoiser(bitmap, albedo_ch="albedo", normals_ch="normals")
    assert isinstance(clean, mi.Bitmap)
    assert clean.pixel_format() == mi.Bitmap.PixelFormat.RGBA
    assert clean.component_format() == mi.Struct.Type.Float32
    assert np.array_equal(np.array(bitmap), before)
    given, pixels = layers(bitmap), np.array(clean)
    assert np.array_equal(pixels[..., 3], given["<root>"][..., 3])
    own = Denoiser(MODEL)
    own.reset(frames=1)
    normals = given["normals"].clip(-1, 1)
    color, alpha = given["<root>"][..., :3], given["<root>"][..., 3]
    expected = own(Frame.from_numpy(color, albedo=given["albedo"].clip(0, 1), normal=normals, alpha=alpha))
    assert np.array_equal(pixels[..., :3], expected[0].permute(1, 2, 0).numpy())
    # Measured: 0.328 of one sample a pixel, 0.172 denoised.
    assert smape(pixels[..., :3], reference[..., :3]) < 0.7 * smape(given["<root>"][..., :3], reference[..., :3])
    assert denoiser.denoiser.report.missing == ["depth", "motion"]


def test_bitmaps_without_layers_keep_their_pixel_format(mi: Any) -> None:
    denoiser = MitsubaDenoiser((WIDTH, HEIGHT), model="noisy")
    for channels, name in ((1, "Y"), (2, "YA"), (3, "RGB"), (4, "RGBA")):
        kind = getattr(mi.Bitmap.PixelFormat, name)
        pixels = noise(channels)
        clean = denoiser(mi.Bitmap(pixels if channels > 1 else pixels[..., 0], kind))
        assert clean.pixel_format() == kind
        # The mean of three equal numbers is rounded.
        np.testing.assert_allclose(np.array(clean).reshape(pixels.shape), pixels, rtol=3e-7)


def test_bitmaps_of_other_component_formats_are_converted(mi: Any) -> None:
    denoiser = MitsubaDenoiser((WIDTH, HEIGHT), model="noisy")
    half = noise(3).astype(np.float16)
    assert np.array_equal(np.array(denoiser(mi.Bitmap(half))), half.astype(np.float32))
    encoded = (255 * noise(3)).astype(np.uint8)
    value = encoded / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    clean = denoiser(mi.Bitmap(encoded))
    assert not clean.srgb_gamma()
    np.testing.assert_allclose(np.array(clean), linear, rtol=1e-4, atol=1e-6)


def test_alpha_is_denoised_on_request(mi: Any) -> None:
    noisy = noise(4)
    # Where nothing is empty or full, alpha has no edge, and is filtered by the kernels of a method that has some.
    noisy[..., 3] = np.random.default_rng(1).uniform(0.2, 0.8, (HEIGHT, WIDTH))
    denoisers = [MitsubaDenoiser((WIDTH, HEIGHT), denoise_alpha=on, model="joint_bilateral") for on in (False, True)]
    kept, denoised = (np.array(denoiser(mi.Bitmap(noisy))) for denoiser in denoisers)
    assert np.array_equal(kept[..., 3], noisy[..., 3])
    assert denoised[..., 3].min() >= 0
    assert denoised[..., 3].max() <= 1
    assert denoised[..., 3].std() < 0.5 * noisy[..., 3].std()
    assert abs(denoised[..., 3].mean() - noisy[..., 3].mean()) < 0.1


def test_albedo_and_normals_of_mitsuba_are_mended(mi: Any) -> None:
    color, albedo, normals = noise(3), noise(3, 1), noise(3, 2) * 2 - 1
    names = ["R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "normals.X", "normals.Y", "normals.Z"]
    denoiser = MitsubaDenoiser((WIDTH, HEIGHT), albedo=True, normals=True, model=MODEL)

    def result(albedo: Array, normals: Array) -> Array:
        pixels = np.concatenate([color, albedo, normals], axis=2)
        bitmap = mi.Bitmap(pixels, mi.Bitmap.PixelFormat.MultiChannel, names)
        return np.array(denoiser(bitmap, albedo_ch="albedo", normals_ch="normals"))

    rough, overshot = albedo.copy(), normals.copy()
    rough[3:6], albedo[3:6], overshot[7], normals[7] = 93, 1, -1.5, -1
    assert np.array_equal(result(rough, overshot), result(albedo, normals))


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_tensors_are_denoised_as_arrays_are(variant: str, request: pytest.FixtureRequest) -> None:
    mi = request.getfixturevalue("mi" if variant == "scalar_rgb" else "ad")
    color, albedo, normals = noise(4), noise(3, 1), noise(3, 2) * 2 - 1
    denoiser = MitsubaDenoiser((WIDTH, HEIGHT), albedo=True, normals=True, model=MODEL)
    clean = denoiser(mi.TensorXf(color), mi.TensorXf(albedo), normals=mi.TensorXf(normals), to_sensor=None)
    assert type(clean) is mi.TensorXf
    own = Denoiser(MODEL)
    own.reset(frames=1)
    expected = own(Frame.from_numpy(np.ascontiguousarray(color[..., :3]), albedo=albedo, normal=normals))
    assert np.array_equal(clean.numpy()[..., 3], color[..., 3])
    # Memory of another layout may be summed in another order.
    np.testing.assert_allclose(clean.numpy()[..., :3], expected[0].permute(1, 2, 0).numpy(), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("gradients", [False, True], ids=["image", "gradients"])
def test_tensors_cross_to_torch_and_back_without_copies(
    ad: Any, gradients: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    drjit = importlib.import_module("drjit")
    seen: list[list[int]] = []

    def step(self: Any, denoiser: Denoiser, noisy: Tensor, buffers: dict[str, Tensor], **settings: Any) -> Tensor:
        clean = original(self, denoiser, noisy, buffers, **settings)
        seen.append([each.data_ptr() for each in (noisy, *buffers.values(), clean)])
        return clean

    original = MitsubaDenoiser._step
    monkeypatch.setattr(MitsubaDenoiser, "_step", step)
    tensors = [ad.TensorXf(noise(3, seed)) for seed in range(3)]
    drjit.eval(*tensors)
    if gradients:
        drjit.enable_grad(*tensors)
    clean = MitsubaDenoiser((WIDTH, HEIGHT), albedo=True, normals=True, model=MODEL)(*tensors)
    assert seen == [[drjit.detach(each).numpy().ctypes.data for each in (*tensors, clean)]]


def of_torch(color: Array, weights: Tensor, **features: Tensor) -> dict[str, Array]:
    """Gradients of the weighted sum of the image, by torch alone, in the memory layout of Mitsuba."""
    leaves = {"color": torch.from_numpy(color), **features}
    leaves = {name: each.clone().requires_grad_() for name, each in leaves.items()}
    denoiser = Denoiser(MODEL, differentiable=True)
    denoiser.reset(frames=1)
    image = denoiser(Frame(**{name: each.permute(2, 0, 1)[None] for name, each in leaves.items()}))
    (image[0].permute(1, 2, 0) * weights).sum().backward()
    return {name: each.grad.numpy() for name, each in leaves.items() if each.grad is not None}


def test_gradients_are_those_of_torch(ad: Any) -> None:
    drjit = importlib.import_module("drjit")
    color, albedo, normals, weights = noise(3), noise(3, 1), noise(3, 2) * 2 - 1, noise(3, 3)
    expected = of_torch(
        color, torch.from_numpy(weights), albedo=torch.from_numpy(albedo), normal=torch.from_numpy(normals)
    )
    tensors = [ad.TensorXf(each) for each in (color, albedo, normals)]
    drjit.enable_grad(*tensors)
    denoiser = MitsubaDenoiser((WIDTH, HEIGHT), albedo=True, normals=True, model=MODEL)
    clean = denoiser(*tensors)
    assert type(clean) is ad.TensorXf
    drjit.backward(drjit.sum(clean * ad.TensorXf(weights), axis=None))
    for name, tensor in zip(("color", "albedo", "normal"), tensors, strict=True):
        found = drjit.grad(tensor).numpy()
        largest = np.abs(expected[name]).max()
        assert largest > 0
        # The same operations in float32; sums of threads may be added in another order.
        np.testing.assert_allclose(found, expected[name], rtol=0, atol=1e-4 * largest)
    assert all(each.grad is None for each in denoiser.denoiser.model.parameters())


def test_gradients_end_at_the_history(ad: Any) -> None:
    drjit = importlib.import_module("drjit")
    flow = ad.TensorXf(np.zeros((HEIGHT, WIDTH, 2), np.float32))
    first, second = ad.TensorXf(noise(3)), ad.TensorXf(noise(3, 1))
    drjit.enable_grad(first, second)
    denoiser = MitsubaDenoiser((WIDTH, HEIGHT), temporal=True, model=MODEL)
    before = denoiser(first, flow=flow)
    after = denoiser(second, flow=flow, previous_denoised=before)
    drjit.backward(drjit.sum(after, axis=None))
    assert np.abs(drjit.grad(second).numpy()).max() > 0
    assert np.abs(drjit.grad(first).numpy()).max() == 0
    # Each frame can be differentiated by itself, the earlier one after the later one, too.
    drjit.backward(drjit.sum(before, axis=None))
    assert np.abs(drjit.grad(first).numpy()).max() > 0


def test_flow_leads_from_the_previous_to_the_current_frame(mi: Any) -> None:
    """The pattern at x is now at x + 2 and y + 1: with a flow of (2, 1), the history equals the current frame."""
    pattern, moved = noise(3), np.roll(noise(3), (1, 2), axis=(0, 1))
    inside = (slice(4, -4), slice(4, -4))

    def second(flow: tuple[float, float]) -> Array:
        denoiser = MitsubaDenoiser((WIDTH, HEIGHT), temporal=True, model="accumulated")
        vectors = mi.TensorXf(np.broadcast_to(np.float32(flow), (HEIGHT, WIDTH, 2)).copy())
        first = denoiser(mi.TensorXf(pattern), flow=vectors, previous_denoised=mi.TensorXf(pattern))
        result: Array = denoiser(mi.TensorXf(moved), flow=vectors, previous_denoised=first).numpy()
        return result

    np.testing.assert_allclose(second((2, 1))[inside], moved[inside], rtol=1e-5, atol=1e-6)
    assert np.abs(second((0, 0))[inside] - moved[inside]).mean() > 0.05
    for wrong in ((-2, -1), (2, -1), (-2, 1)):
        with pytest.warns(UserWarning, match="motion"):
            image = second(wrong)
        assert np.abs(image[inside] - moved[inside]).mean() > 0.05


def test_previous_denoised_tells_where_a_shot_begins(mi: Any) -> None:
    frames = [mi.TensorXf(noise(3, seed)) for seed in range(3)]
    frames[2][0, 0, 0] = float("nan")
    flow = mi.TensorXf(np.zeros((HEIGHT, WIDTH, 2), np.float32))
    own = Denoiser(MODEL)
    motion = torch.zeros(1, 2, HEIGHT, WIDTH)
    shot = [own(Frame(each.torch().permute(2, 0, 1)[None], motion=motion))[0].permute(1, 2, 0) for each in frames]
    own.reset()
    cut = own(Frame(frames[2].torch().permute(2, 0, 1)[None], motion=motion))[0].permute(1, 2, 0)
    assert not torch.equal(shot[2], cut)
    starts: list[tuple[Any, Tensor]] = [(frames[1], shot[2]), (None, cut), (frames[2], cut), (mi.TensorXf(), cut)]
    denoiser = MitsubaDenoiser((WIDTH, HEIGHT), temporal=True, model=MODEL)
    for previous, expected in starts:
        result = denoiser(frames[0], flow=flow)
        for frame, before in ((frames[1], result), (frames[2], previous)):
            result = denoiser(frame, flow=flow, previous_denoised=before)
        np.testing.assert_allclose(result.numpy(), expected.numpy(), rtol=1e-3, atol=1e-3)


def test_arguments_that_do_not_fit_are_told_in_one_line(mi: Any) -> None:
    color, small = mi.TensorXf(noise(3)), mi.TensorXf(noise(3)[1:])

    def denoised(made: dict[str, Any], *arguments: Any, **named: Any) -> Any:
        return MitsubaDenoiser((WIDTH, HEIGHT), **{"model": "noisy", **made})(*arguments, **named)

    cases: list[tuple[dict[str, Any], tuple[Any, ...], dict[str, Any], str]] = [
        ({}, (small,), {}, "noisy: expected shape (36, 64, 3 or 4) for images of 64x36"),
        ({}, (mi.TensorXf(noise(9)),), {}, "found (36, 64, 9)"),
        ({}, (noise(3),), {}, "noisy: expected a mitsuba.Bitmap or TensorXf, found ndarray"),
        ({"albedo": True}, (color,), {}, "albedo: expected, as the denoiser was made with albedo=True, found none"),
        ({"albedo": True}, (color, small), {}, "albedo: expected shape (36, 64, 3)"),
        ({"albedo": True}, (color, noise(3)), {}, "albedo: expected a TensorXf like noisy, found ndarray"),
        ({"temporal": True}, (color,), {}, "flow: expected, as the denoiser was made with temporal=True, found none"),
        ({"temporal": True}, (color,), {"flow": color}, "flow: expected shape (36, 64, 2)"),
        ({}, (mi.Bitmap(noise(3)),), {"albedo_ch": "alb"}, "albedo_ch: expected the name of a layer of the bitmap"),
        ({"albedo": True}, (mi.Bitmap(noise(3)),), {}, "albedo: expected, as the denoiser was made with albedo=True"),
        ({}, (mi.Bitmap(noise(3), mi.Bitmap.PixelFormat.XYZ),), {}, "in a pixel format of Y, YA, RGB, RGBA, found XYZ"),
        ({"model": "nothing"}, (color,), {}, "nothing"),
        ({"device": "nowhere"}, (color,), {}, "device 'nowhere'"),
    ]
    for made, arguments, named, message in cases:
        assert message in refused(denoised, made, *arguments, **named)
    for wrong in ((64,), (64, 0), (64.5, 36)):
        assert "input_size:" in refused(MitsubaDenoiser, wrong)


@pytest.mark.parametrize("missing", ["mitsuba", "drjit"])
def test_without_mitsuba_one_line_says_what_to_install(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if missing == "drjit":
        pytest.importorskip("mitsuba")
    monkeypatch.setitem(sys.modules, missing, None)
    assert re.search(rf"{missing}.*mcdenoise\[render\]", refused(MitsubaDenoiser, (WIDTH, HEIGHT)))
