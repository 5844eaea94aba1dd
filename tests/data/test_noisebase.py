"""Noisebase's arrays, written by zarr from numbers that are known; none of the published files is here.

What is expected follows from the equations of the format, in float64.
"""

import json
import tracemalloc
import warnings
import zipfile
import zlib
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planes import seen_at

from mcdenoise.data import Sequence, open_sequence
from mcdenoise.data.readers import noisebase
from mcdenoise.data.readers.noisebase import open_noisebase
from mcdenoise.errors import InputError

zarr = pytest.importorskip("zarr")

# The sizes are those of the image that the frames are crops of, and of the crops.
WHOLE, SIZE, SAMPLES, FRAMES = (30, 40), (20, 24), 6, 3
CROP = (4, 7)
EXPOSURE = (-3.0, 2.5)


def matrices() -> np.ndarray:
    """World to clip for row vectors, as DirectX has them: a camera at (0.1 t, 0, -3) that looks along z, y up."""
    focal = 1.5
    projection = np.array([[focal * WHOLE[0] / WHOLE[1], 0, 0, 0], [0, focal, 0, 0], [0, 0, 1.001, 1], [0, 0, -0.1, 0]])
    views = []
    for number in range(FRAMES):
        view = np.eye(4)
        view[3, :3] = -0.1 * number, 0, 3
        views.append(view @ projection)
    return np.array(views).astype(np.float32)


def encode(radiance: np.ndarray) -> np.ndarray:
    """``(4, ...)`` bytes of ``(3, ...)``: the least exponent under which the largest channel is at most 1."""
    low, high = EXPOSURE
    exponents = np.exp((np.arange(256) + 1) / 256 * (high - low) + low)
    exponent = np.searchsorted(exponents, radiance.max(0)).clip(0, 255)
    return np.concatenate([np.rint(radiance / exponents[exponent] * 255), exponent[None]]).astype(np.uint8)


def decode(coded: np.ndarray) -> np.ndarray:
    low, high = EXPOSURE
    return coded[:3] / 255.0 * np.exp((coded[3].astype(np.float64) + 1) / 256 * (high - low) + low)


def arrays(number: int, samples: int = SAMPLES) -> dict[str, np.ndarray]:
    """One frame: a slanted, wavy surface, hit by each sample at its place in the pixel; sky in the uppermost rows."""
    g, camera = np.random.default_rng(number), matrices()[number].astype(np.float64)
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]] + np.array(CROP)[:, None, None]
    spread = g.random((2, *SIZE, samples))
    x = (columns[..., None] + spread[0]) / WHOLE[1] * 2 - 1
    y = 1 - (rows[..., None] + spread[1]) / WHOLE[0] * 2
    depth = 4 + x - y + 0.5 * np.sin(5 * x) * np.cos(4 * y)
    position = np.stack([depth * x / camera[0, 0], depth * y / camera[1, 1], depth - 3]) + np.array(
        [0.1 * number, 0, 0]
    ).reshape(3, 1, 1, 1)
    radiance = g.exponential(size=(3, *SIZE, samples)) * 0.8
    normal, diffuse = g.uniform(-0.6, 0.6, (3, *SIZE, samples)), g.random((3, *SIZE, samples))
    normal[:, :3], diffuse[:, :3] = 0, 0
    return {
        "color": encode(np.minimum(radiance, 10)),
        "exposure": np.array(EXPOSURE, np.float32),
        "reference": g.random((3, *SIZE)).astype(np.float32),
        "position": position.astype(np.float32),
        "motion": g.normal(size=(3, *SIZE, samples)).astype(np.float32),
        "normal": normal.astype(np.float16),
        "diffuse": diffuse.astype(np.float16),
        "view_proj_mat": matrices()[number],
        "crop_offset": np.array(CROP, np.int32),
        "camera_position": np.array([0.1 * number, 0, -3], np.float32),
    }


def write(path: Path, content: dict[str, np.ndarray], axis: bool = False, **chunks: Any) -> Path:
    """Write a file as the published ones are: chunks of one frame and four samples, LZ4HC."""
    from numcodecs import Blosc

    with zarr.storage.ZipStore(path, mode="w") as store:
        group = zarr.create_group(store, zarr_format=2)
        for name, values in content.items():
            shape = list(values.shape)
            if axis:
                shape[0] = 1
            if values.ndim - axis == 4:
                shape[-1] = 4
            array = group.create_array(
                name,
                shape=values.shape,
                dtype=values.dtype,
                chunks=chunks.get(name, tuple(shape)),
                compressors=Blosc("lz4hc", 9),
            )
            array[...] = values
    return path


@pytest.fixture(autouse=True)
def whole_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """The published sets are crops of 1920 x 1080; here the image is smaller."""
    monkeypatch.setattr(noisebase, "_RENDERED", WHOLE)


def frames_of(folder: Path) -> Path:
    folder.mkdir()
    for number in range(FRAMES):
        write(folder / f"frame{number:04d}.zip", arrays(number))
    return folder


def training_set(path: Path) -> Path:
    frames = [arrays(number) for number in range(FRAMES)]
    return write(path, {name: np.stack([frame[name] for frame in frames]) for name in frames[0]}, axis=True)


@pytest.fixture(params=["test", "training"])
def opened(request: pytest.FixtureRequest, tmp_path: Path) -> Sequence:
    if request.param == "test":
        return open_sequence(frames_of(tmp_path / "scene"))
    return open_sequence(training_set(tmp_path / "scene.zip"))


def test_buffers_and_frames_that_are_found(opened: Sequence) -> None:
    assert opened.layout == "noisebase"
    assert opened.numbers == opened.reference_numbers == list(range(FRAMES))
    assert opened.size == SIZE
    assert not opened.warnings
    assert not opened.unused
    assert opened.buffers == {row.buffer for row in opened.table}
    frame = opened.frame(1)
    assert opened.buffers == {name for name, _ in frame.items()}
    assert opened.frame(1, reference=False).reference is None
    words = {row.buffer: row.reading for row in opened.table}
    assert f"cropped from {WHOLE[1]} x {WHOLE[0]}" in words["view_projection"]


@pytest.mark.parametrize("number", [0, FRAMES - 1])
def test_means_and_variance_are_those_of_the_samples(opened: Sequence, number: int) -> None:
    frame, known = opened.frame(number), arrays(number)
    samples = decode(known["color"])
    expected = {
        "color": samples.mean(-1),
        "variance": samples.var(-1, ddof=1) / SAMPLES,
        "albedo": known["diffuse"].astype(np.float64).mean(-1),
        "normal": known["normal"].astype(np.float64).mean(-1),
        "position": known["position"].astype(np.float64).mean(-1),
        "previous_position": (known["position"].astype(np.float64) + known["motion"]).mean(-1),
        "reference": known["reference"],
        "samples": np.moveaxis(samples, -1, 0),
    }
    for name, values in expected.items():
        # Sums in double precision, rounded once to single.
        np.testing.assert_allclose(getattr(frame, name)[0].numpy(), values, rtol=3e-7, atol=1e-7, err_msg=name)
    assert opened.frame(number, buffers={"albedo"}).samples is None


def test_positions_are_seen_at_their_pixels(tmp_path: Path) -> None:
    """Each at its own place within a pixel, with one sample in the middle of it."""
    content = arrays(2, samples=1)
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    frame = open_sequence(write(tmp_path / "frame2.zip", content)).frame(2)
    assert frame.variance is None
    position = frame.position[0].double().permute(1, 2, 0).numpy()
    x, y, clip = seen_at(position, frame.view_projection[0])
    spread = np.random.default_rng(2).random((2, *SIZE, 1))[..., 0]
    # Single precision of positions and matrix: some 1e-6 of a coordinate of a few units, over 40 pixels.
    np.testing.assert_allclose(x, columns + spread[0], atol=1e-3)
    np.testing.assert_allclose(y, rows + spread[1], atol=1e-3)
    depth = frame.depth[0, 0].numpy()
    assert np.isinf(depth[:3]).all()
    np.testing.assert_allclose(depth[3:], clip[3:, :, 3], rtol=1e-6)


def changed(path: Path, target: Path, change: dict[str, bytes | None]) -> Path:
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as copy:
        for name in source.namelist():
            content = change.get(name, source.read(name))
            if content is not None:
                copy.writestr(name, content)
    return target


def described(path: Path, name: str, **values: Any) -> dict[str, bytes | None]:
    with zipfile.ZipFile(path) as file:
        return {f"{name}/.zarray": json.dumps(json.loads(file.read(f"{name}/.zarray")) | values).encode()}


@pytest.mark.usefixtures("no_finalizers")
def test_compressed_bombs_and_false_sizes_are_refused_before_memory_is_allocated(tmp_path: Path) -> None:
    path = write(tmp_path / "frame0.zip", arrays(0))
    huge = [4, 2**14, 2**14, 6]
    first = "color/0.0.0.0"
    with zipfile.ZipFile(path) as file:
        chunk = file.read(first)
    lying = {
        "chunk": {first: chunk[:4] + (2**31 - 1).to_bytes(4, "little") + chunk[8:]},
        "short": {first: chunk[:10]},
        "empty": {first: b""},
        "missing": {first: None},
        "shape": described(path, "color", shape=huge),
        "chunks": described(path, "color", shape=huge, chunks=huge),
        "bomb": described(path, "color", shape=[4, 2**12, 2**11, 1], chunks=[4, 2**12, 2**11, 1], compressor=None)
        | {first: bytes(2**24)},
        "negative": described(path, "color", shape=[4, -20, -24, 6]),
        "words": described(path, "color", shape="many"),
        "deep": {"color/.zarray": b"[" * 50_000},
        "object": described(path, "color", dtype="|O"),
        "pickle": described(path, "color", filters=[{"id": "pickle"}]),
        "codec": described(path, "color", compressor={"id": "lzma"}),
        "order": described(path, "normal", order="F"),
        "three": described(path, "normal", zarr_format=3),
        "samples": described(path, "normal", shape=[3, *SIZE, SAMPLES + 1]),
        "exposure": described(path, "exposure", shape=[3]),
        "without": {"exposure/.zarray": None},
    }
    for name, change in lying.items():
        copy = changed(path, tmp_path / f"{name}.zip", change)
        tracemalloc.start()
        with pytest.raises(InputError, match=f"{name}.zip") as told:
            open_noisebase([copy], lambda numbers: numbers, where=str(copy)).frame(0)
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert most < 2**22, f"{name}: {most}"
        assert str(told.value).isprintable(), name
        assert len(str(told.value)) < 700 + len(str(copy)), name


@pytest.mark.parametrize(
    ("name", "method"), [("color/.zarray", zipfile.ZIP_DEFLATED), ("color/0.0.0.0", zipfile.ZIP_LZMA)]
)
def test_a_member_that_is_larger_than_it_says(tmp_path: Path, name: str, method: int) -> None:
    """Sizes and checksum are those of its first bytes; what follows are zeros."""
    path = write(tmp_path / "frame0.zip", arrays(0))
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(tmp_path / "bomb.zip", "w") as bomb:
        for each in source.namelist():
            content = source.read(each)
            if each != name:
                bomb.writestr(each, content)
                continue
            bomb.writestr(each, content + bytes(2**24), method)
            # The directory at the end of the zip is written when it is closed.
            bomb.infolist()[-1].CRC, bomb.infolist()[-1].file_size = zlib.crc32(content), len(content)
    tracemalloc.start()
    # Of deflate, the first bytes are whole and all that is read.
    with pytest.raises(InputError, match=r"bomb\.zip") if method != zipfile.ZIP_DEFLATED else nullcontext():
        open_sequence(tmp_path / "bomb.zip").frame(0)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 2**23


# Protocol 0 of a call of os.mkdir, written out, since no code here imports the module that makes and reads such bytes.
UNPICKLED = "cos\nmkdir\n(V{path}\ntR."


@pytest.mark.parametrize(
    ("name", "dtype", "codec"),
    [("normal", "|O", "filters"), ("normal", "<f2", "compressor"), ("stranger", "|O", "compressor")],
)
def test_nothing_is_unpickled_and_nothing_is_written_elsewhere(
    tmp_path: Path, name: str, dtype: str, codec: str
) -> None:
    path = write(tmp_path / "frame0.zip", arrays(0))
    (about,) = described(path, "normal", dtype=dtype, filters=None, compressor=None).values()
    about = json.loads(about) | {codec: [{"id": "pickle"}] if codec == "filters" else {"id": "pickle"}}
    content = UNPICKLED.format(path=tmp_path / "unpickled").encode()
    hostile = changed(path, tmp_path / "hostile0.zip", {f"{name}/.zarray": None})
    with zipfile.ZipFile(hostile, "a") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        file.writestr(f"{name}/.zarray", json.dumps(about))
        for each in (f"{name}/0.0.0.0", f"{name}/0.0.0.1", "../outside", str(tmp_path / "absolute")):
            file.writestr(each, content)
    with nullcontext() if name == "stranger" else pytest.raises(InputError, match=r"hostile0\.zip"):
        open_sequence(hostile).frame(0)
    assert {each.name for each in tmp_path.iterdir()} == {"frame0.zip", "hostile0.zip"}
    assert not (tmp_path.parent / "outside").exists()
