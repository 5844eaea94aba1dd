"""Models, skies and normal maps of packages with free licences, fetched by the packages' own clients into a folder.

Archives are read where they are: names in them never become paths. Scenes are drawn from what is there, and without
any of it from procedural objects.
"""

from __future__ import annotations

import base64
import hashlib
import re
import subprocess
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcdenoise.data.exr import read_exr
from mcdenoise.data.files import make_folder
from mcdenoise.errors import InputError
from mcdenoise.interruption import unfinished
from mcdenoise.reading import check_file, read_bytes
from mcdenoise.user_cache import cache_file

Image = NDArray[np.float32]

# The package of models, and the folder of its archives inside it.
_DEBIAN, _FURNITURE = "sweethome3d-furniture", "usr/share/sweethome3d/furniture"
_NPM = "@pmndrs/assets@1.7.0"
_KEPT = re.compile(r"package/(hdri|normals)/([a-z0-9_]{1,40}\.(?:exr|webp))\.js")
_ENCODED = re.compile(rb"base64,([A-Za-z0-9+/=]+)")
_PATIENCE = 900  # seconds
_LARGEST_MEMBER, _LARGEST_ARCHIVE, _LARGEST_SIDE = 12 << 20, 256 << 20, 8192
_TEXTURE = 512
# Coordinates in textures beyond this have no digits left for the texel, and some models have them.
_FARTHEST = 1000.0
_LICENCES = {
    "BlendSwap-CC-0": "CC0 1.0",
    "BlendSwap-CC-BY": "CC-BY 3.0",
    "KatorLegaz": "CC-BY 3.0 US",
    "Reallusion": "CC-BY 3.0 US",
    "Scopia": "CC-BY 3.0",
}
_CREDITS = {".exr": "Poly Haven", ".webp": "emmelleppi/normal-maps"}
# Where the catalogue does not say on what things stand, these words of a name do.
_FLAT = ("table", "desk", "shel", "cabinet", "chest", "drawer", "sideboard", "commode", "bench", "stool", "board")
# A tenth of the names is for measuring only.
_PARTS = 10


@dataclass(frozen=True, eq=False)
class Surface:
    """A material of a model.

    Args:
        color: linear reflectance, ``(3,)`` or a texture ``(H, W, 3)``.
        opacity: a number, or ``(H, W, 1)``.
        shine: reflectance of the highlight.
        exponent: of Phong's highlight.
    """

    color: Image
    opacity: float | Image = 1.0
    shine: float = 0.0
    exponent: float = 10.0


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of one material; all parts of a model together fill the cube from -1 to 1.

    Args:
        vertices: ``(N, 3)``, y up, +z is the front.
        faces: ``(M, 3)`` indices of vertices.
        uv: ``(N, 2)`` or ``None``.
        normals: ``(N, 3)`` or ``None``.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    uv: NDArray[np.float32] | None
    normals: NDArray[np.float32] | None

    @property
    def texcoords(self) -> NDArray[Any]:
        """``(N, 2)`` as Mitsuba has them, whose images begin at the top; 0 where there are none."""
        return np.zeros((len(self.vertices), 2)) if self.uv is None else self.uv * (1, -1) + (0, 1)


@dataclass(frozen=True)
class Lamp:
    """Where a model sends out light: place in the model's cube, and diameter in metres."""

    center: tuple[float, float, float]
    diameter: float


@dataclass(frozen=True)
class Model:
    """A piece of furniture or a small object.

    Args:
        name: unique name.
        credit: author and licence.
        category: such as ``"Living room"``.
        size: width, height, depth in metres; the front faces +z.
        elevation: height above the floor at which it hangs, metres.
        top: height of the surface that things stand on, metres; 0 without one.
        opening: whether it is a door or a window.
        lamps: its light sources.
    """

    name: str
    credit: str
    category: str
    size: tuple[float, float, float]
    elevation: float
    top: float
    opening: bool
    lamps: tuple[Lamp, ...]
    archive: Path = field(repr=False)
    member: str = field(repr=False)
    rotation: tuple[float, ...] = field(repr=False)

    def read(self) -> list[tuple[Mesh, Surface]]:
        """The triangles of each material.

        Raises:
            InputError: the model is damaged or larger than a scene can hold.
        """
        try:
            with zipfile.ZipFile(self.archive) as files:
                return _read_obj(files, self.member, np.reshape(self.rotation, (3, 3)))
        except (KeyError, ValueError, IndexError, OverflowError, zipfile.BadZipFile, OSError) as error:
            raise InputError(f"{self.archive}: {self.member}: expected a model, found {error}") from error


@dataclass(frozen=True)
class Assets:
    """What scenes are drawn from.

    Args:
        models: pieces of furniture and small objects.
        skies: files of lat-long skies.
        normals: files of normal maps.
    """

    models: tuple[Model, ...] = ()
    skies: tuple[Path, ...] = ()
    normals: tuple[Path, ...] = ()

    @cached_property
    def digest(self) -> str:
        """Checksum of names and sizes, the same on any machine with the same packages."""
        names = [f"{m.name} {m.size} {m.archive.stat().st_size}" for m in self.models]
        names += [f"{path.name} {path.stat().st_size}" for path in (*self.skies, *self.normals)]
        return hashlib.sha256("\n".join(names).encode()).hexdigest()[:16]

    def part(self, unseen: bool) -> Assets:
        """The tenth that is never trained on, or all others."""

        def keep(name: str) -> bool:
            return (hashlib.sha256(name.encode()).digest()[0] % _PARTS == 0) == unseen

        return Assets(
            tuple(model for model in self.models if keep(model.name)),
            tuple(path for path in self.skies if keep(path.stem)),
            tuple(path for path in self.normals if keep(path.stem)),
        )

    def credit(self, path: Path) -> str:
        """Name, author and licence of a sky or a normal map."""
        return f"{path.stem} ({_CREDITS[path.suffix]}, by @pmndrs/assets, CC0 1.0)"


def open_assets(folder: Path | None, say: Callable[[str], None]) -> Assets:
    """The assets in a folder; packages that are not there are fetched, and one line says what is missing.

    Args:
        folder: created if necessary; by default one in the user's cache.
        say: shows one line.

    Raises:
        InputError: the folder cannot be written, or an archive in it is damaged.
    """
    folder = folder or cache_file("assets")
    make_folder(folder)
    furniture, images = folder / _FURNITURE, folder / "images"
    for target, client, package in ((furniture, _fetch_furniture, _DEBIAN), (images, _fetch_images, _NPM)):
        if target.is_dir():
            continue
        try:
            with tempfile.TemporaryDirectory(dir=folder, prefix=".fetch-") as work, unfinished(Path(work)):
                found = client(Path(work), package)
                target.parent.mkdir(parents=True, exist_ok=True)
                found.rename(target)
        except (OSError, subprocess.SubprocessError, tarfile.TarError, ValueError) as error:
            reason = str(getattr(error, "stderr", "") or error).strip().splitlines()[-1:] or ["no answer"]
            say(f"{package}: cannot be fetched ({reason[0][:200]}); scenes are made without it, of procedural objects")
    models = sorted((model for path in furniture.glob("*.sh3f") for model in _catalogue(path)), key=lambda m: m.name)
    return Assets(tuple(models), tuple(sorted(images.glob("*.exr"))), tuple(sorted(images.glob("*.webp"))))


def read_sky(path: Path) -> Image:
    """A lat-long image, ``(H, W, 3)`` radiance."""
    return np.maximum(read_exr(path)[0][..., :3], 0).astype(np.float32)


def read_normal_map(path: Path) -> Image:
    """``(H, W, 3)`` in 0 to 1."""
    return _read_image(read_bytes(path, _LARGEST_MEMBER), path)[..., :3]


def _run(work: Path, *command: str) -> None:
    subprocess.run(command, cwd=work, check=True, capture_output=True, text=True, timeout=_PATIENCE)


def _fetch_furniture(work: Path, package: str) -> Path:
    """Fetch a package of Debian into a folder; returns the folder of its archives."""
    _run(work, "apt-get", "download", package)
    (file,) = work.glob("*.deb")
    _run(work, "dpkg-deb", "-x", file.name, "x")
    return work / "x" / _FURNITURE


def _fetch_images(work: Path, package: str) -> Path:
    """Fetch a package of npm into a folder; returns the folder of its images."""
    _run(work, "npm", "pack", package)
    (file,) = work.glob("*.tgz")
    ready = work / "images"
    ready.mkdir()
    with tarfile.open(file) as files:
        for member in files:
            found = _KEPT.fullmatch(member.name)
            content = files.extractfile(member) if found and member.size <= _LARGEST_MEMBER else None
            encoded = _ENCODED.search(content.read()) if content else None
            if found and encoded:
                (ready / found[2]).write_bytes(base64.b64decode(encoded[1]))
    return ready


def _catalogue(path: Path) -> Iterator[Model]:
    """The models that an archive lists."""
    try:
        check_file(path)
        if path.stat().st_size > _LARGEST_ARCHIVE:
            raise ValueError(f"more than {_LARGEST_ARCHIVE} bytes")
        with zipfile.ZipFile(path) as files:
            text = _member(files, "PluginFurnitureCatalog.properties").decode("latin-1")
            present = set(files.namelist())
    except (KeyError, ValueError, zipfile.BadZipFile, OSError) as error:
        raise InputError(f"{path}: expected an archive of models, found {error}; remove it") from error
    table: dict[str, dict[str, str]] = {}
    for key, number, value in re.findall(r"(?m)^(\w+)#(\d+)=(.*?)\s*$", text):
        table.setdefault(number, {})[key] = value
    licence = _LICENCES.get(path.stem, "unknown licence")
    for row in table.values():
        member = row.get("model", "").lstrip("/")
        try:
            size = (_metres(row["width"]), _metres(row["height"]), _metres(row["depth"]))
            lamps = tuple(_lamps(row, size))
            rotation = tuple(map(float, row.get("modelRotation", "1 0 0 0 1 0 0 0 1").split()))
            flat = any(word in member.lower() for word in _FLAT)
            top = _metres(row.get("dropOnTopElevation", row["height"] if flat else "0"))
            elevation = _metres(row.get("elevation", "0"))
        except (KeyError, ValueError):
            continue
        if member not in present or len(rotation) != 9 or not 0.005 < max(size) < 30:
            continue
        name, credit = f"{path.stem}/{Path(member).stem}", f"{row.get('creator', path.stem)}, {licence}"
        category, opening = row.get("category", ""), row.get("doorOrWindow") == "true"
        yield Model(name, credit, category, size, elevation, max(top, 0.0), opening, lamps, path, member, rotation)


def _metres(text: str) -> float:
    return float(text) / 100


def _lamps(row: dict[str, str], size: tuple[float, float, float]) -> Iterator[Lamp]:
    """Sources of light; the catalogue measures from the left, the back and the bottom."""
    columns = [row.get(f"lightSource{axis}", "").split() for axis in "XZY"]
    diameters = row.get("lightSourceDiameter", "").split() or ["4"]
    for number, (x, up, deep) in enumerate(zip(*columns, strict=True)):
        place = [_metres(each) / length * 2 - 1 for each, length in zip((x, up, deep), size, strict=True)]
        yield Lamp((place[0], place[1], place[2]), _metres(diameters[min(number, len(diameters) - 1)]))


def _member(files: zipfile.ZipFile, name: str) -> bytes:
    """A member of at most ``_LARGEST_MEMBER`` bytes, whatever its header says."""
    with files.open(name) as file:
        content = file.read(_LARGEST_MEMBER + 1)
    if len(content) > _LARGEST_MEMBER:
        raise ValueError(f"{name} with more than {_LARGEST_MEMBER} bytes")
    return content


def _near(member: str, name: str) -> str:
    """The member that a file of another member names, beside it."""
    return f"{member.rpartition('/')[0]}/{name.strip().replace(chr(92), '/').rpartition('/')[2]}"


def _read_obj(files: zipfile.ZipFile, member: str, rotation: NDArray[np.float64]) -> list[tuple[Mesh, Surface]]:
    text = _member(files, member).decode("latin-1")
    columns: dict[str, list[str]] = {"v": [], "vt": [], "vn": []}
    faces: dict[str, list[list[str]]] = {}
    surfaces: dict[str, Surface] = {}
    current: list[list[str]] = faces.setdefault("", [])
    for line in text.splitlines():
        kind, _, rest = line.partition(" ")
        if kind in columns:
            columns[kind].append(rest)
        elif kind == "f":
            current.append(rest.split())
        elif kind == "usemtl":
            current = faces.setdefault(rest.strip(), [])
        elif kind == "mtllib" and _near(member, rest) in files.namelist():
            surfaces |= _read_mtl(files, _near(member, rest))
    vertices = _table(columns["v"], 3) @ rotation.T
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices = (vertices - (low + high) / 2) / np.maximum((high - low) / 2, 1e-6)
    normals, uv = _table(columns["vn"], 3) @ rotation.T, _table(columns["vt"], 2)
    gray = Surface(np.full(3, 0.5, np.float32))
    meshes = {name: _triangles(polygons, vertices, uv, normals) for name, polygons in faces.items()}
    return [(mesh, surfaces.get(name, gray)) for name, mesh in meshes.items() if mesh is not None]


def _table(rows: list[str], columns: int) -> NDArray[np.float64]:
    if not rows:
        return np.zeros((0, columns))
    width = len(rows[0].split())
    table = np.array(" ".join(rows).split(), dtype=np.float64).reshape(len(rows), width)[:, :columns]
    if table.shape[1] < columns or not np.isfinite(table).all():
        raise ValueError("coordinates that are no numbers")
    return table


def _triangles(
    polygons: list[list[str]], vertices: NDArray[Any], uv: NDArray[Any], normals: NDArray[Any]
) -> Mesh | None:
    """Fans of triangles; corners with equal indices are one vertex."""
    corners = [(polygon[0], polygon[i], polygon[i + 1]) for polygon in polygons for i in range(1, len(polygon) - 1)]
    if not corners:
        return None
    flat = [corner for triangle in corners for corner in triangle]
    names = {name: number for number, name in enumerate(dict.fromkeys(flat))}
    index = np.array([[int(part or 0) for part in f"{name}//".split("/")[:3]] for name in names], np.int64)
    counts = np.array([len(vertices), len(uv), len(normals)])
    # Positive numbers count from 1, negative ones from the end; 0 stands for none.
    index = np.where(index < 0, index + counts, index - 1)
    if (index >= counts).any() or (index[:, 0] < 0).any():
        raise ValueError("indices of vertices that do not exist")
    has_uv, has_normals = (bool(len(table)) and bool((index[:, k] >= 0).all()) for k, table in ((1, uv), (2, normals)))
    used = uv[index[:, 1]].astype(np.float32) if has_uv else None
    return Mesh(
        vertices[index[:, 0]].astype(np.float32),
        np.array([names[corner] for corner in flat], np.int32).reshape(-1, 3),
        None if used is None or float(np.abs(used).max()) > _FARTHEST else used,
        normals[index[:, 2]].astype(np.float32) if has_normals else None,
    )


def _read_mtl(files: zipfile.ZipFile, member: str) -> dict[str, Surface]:
    rows: dict[str, dict[str, str]] = {}
    row: dict[str, str] = {}
    for line in _member(files, member).decode("latin-1").splitlines():
        kind, _, rest = line.strip().partition(" ")
        if kind == "newmtl":
            row = rows.setdefault(rest.strip(), {})
        else:
            row[kind] = rest.strip()
    return {name: _surface(files, member, row) for name, row in rows.items()}


def _surface(files: zipfile.ZipFile, member: str, row: dict[str, str]) -> Surface:
    def numbers(key: str, default: str) -> NDArray[np.float32]:
        return np.clip(np.array(row.get(key, default).split()[:3], np.float32), 0, 1e4)

    color = linear(np.clip(numbers("Kd", "0.6 0.6 0.6"), 0, 1))
    opacity: float | Image = float(row["d"].split()[-1]) if "d" in row else 1.0
    if "map_Kd" in row:
        # Options stand before the name; names with spaces have none.
        name = row["map_Kd"].split()[-1] if row["map_Kd"].startswith("-") else row["map_Kd"]
        image = _read_image(_member(files, _near(member, name)), Path(name))
        color = linear(image[..., :3]) if image.shape[2] >= 3 else np.repeat(linear(image[..., :1]), 3, -1)
        if image.shape[2] == 4 and float(image[..., 3].min()) < 0.5:
            opacity = image[..., 3:]
    return Surface(color, opacity, float(numbers("Ks", "0 0 0").mean()), float(numbers("Ns", "10")[0]))


def _read_image(content: bytes, path: Path) -> Image:
    """Pixels ``(H, W, C)`` in 0 to 1, of at most ``_TEXTURE`` pixels a side."""
    import OpenImageIO as oiio

    with tempfile.NamedTemporaryFile(suffix=path.suffix if path.suffix.isascii() else "") as file:
        # Not all readers read from memory.
        file.write(content)
        file.flush()
        source = oiio.ImageInput.open(file.name)
        if source is None:
            raise ValueError(f"an image {path.name} that cannot be read")
        spec = source.spec()
        if not 0 < max(spec.width, spec.height) <= _LARGEST_SIDE:
            raise ValueError(f"an image of {spec.width}x{spec.height} pixels")
        pixels = source.read_image("float")
        source.close()
    if pixels is None:
        raise ValueError(f"a damaged image {path.name}")
    image = np.asarray(pixels, np.float32).reshape(spec.height, spec.width, -1)
    step = -(-max(image.shape[:2]) // _TEXTURE)
    if step > 1:
        height, width = (side // step * step for side in image.shape[:2])
        image = image[:height, :width].reshape(height // step, step, width // step, step, -1).mean((1, 3))
    return np.clip(image, 0, 1)


def linear(image: Image) -> Image:
    """Reflectances of values in sRGB."""
    return np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4).astype(np.float32)
