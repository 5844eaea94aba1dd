"""Removal of remaining noise from the references of training data."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.data import open_sequence, write_exr
from mcdenoise.data.files import write_text
from mcdenoise.data.readers.bmfr import read_clean_features
from mcdenoise.data.shards import ERROR, find_shards, open_shard, write_shard
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models import create_model
from mcdenoise.models.oidn import Oidn
from mcdenoise.reading import read_text

# Side of the window in which errors are averaged; part of a middle gray that darker surroundings count as; the largest
# squared relative difference, since a firefly in a half is no error of the other one's denoised image.
_WINDOW, _DARK, _LARGEST = 7, 0.02, 25.0
# What the description of a copy says: how it was made, and from which content.
_FILTER, _SOURCE = "reference_filter", "source"


def cleaned(first: Tensor, second: Tensor, denoise: Callable[[Tensor], Tensor]) -> Tensor:
    """The mean of two independent halves of a reference, denoised as far as that brings it closer to the truth.

    ``(1 - w) m + w d(m)`` with the mean m and its denoised image d(m). ``w = v / (v + b)``, where v is the variance of
    m and b the squared error of a denoised half, both relative to the surroundings and averaged over 7x7 pixels:
    ``v = mean (h_1 - h_2)^2 / 4`` and ``b = mean (d(h_i) - h_j)^2 - 2 v``, at least 0, over both halves. The noise of a
    half is independent of the other one's denoised image, so b also contains what a denoiser takes away: of a texture
    or a caustic that it blurs, more of the mean remains.

    Args:
        first: h_1, ``(B, 3, H, W)`` radiance; a typical value is a middle gray, 0.18.
        second: h_2, the same shape.
        denoise: d, denoises such an image.

    Returns:
        ``(B, 3, H, W)``.

    Source: two buffers that judge each other as in Rousselle et al. 2012, "Adaptive rendering with non-local means
    filtering".

    Example:
        >>> half = torch.full((1, 3, 8, 8), 0.5)
        >>> cleaned(half, half, torch.zeros_like).mean().item()  # nothing to remove
        0.5
    """
    mean = (first + second) / 2
    smooth = denoise(mean)
    level = _around(smooth.mean(1, keepdim=True).clamp_min(0)) + _DARK * 0.18

    def squared(a: Tensor, b: Tensor) -> Tensor:
        return _around(((a - b) / level).square().mean(1, keepdim=True).clamp_max(_LARGEST))

    variance = squared(first, second) / 4
    error = (squared(denoise(first), second) + squared(denoise(second), first)) / 2 - 2 * variance
    weight = variance / (variance + error.clamp_min(0) + torch.finfo(variance.dtype).eps)
    return torch.lerp(mean, smooth, weight)


def _around(image: Tensor) -> Tensor:
    return F.avg_pool2d(image, _WINDOW, 1, _WINDOW // 2, count_include_pad=False)


def clean_references(source: Path, out: Path) -> Path:
    """Copy a packed take, or a sequence in the BMFR layout, with its references denoised by Open Image Denoise.

    A take holds the halves of its references, of which :func:`cleaned` removes the noise that can be removed. Of a
    sequence the references are denoised wholly.

    A network trained with a relative error learns the median of noisy references, which is darker than their mean, and
    much noise remains in a few samples per pixel where light is hard to find. Open Image Denoise at high quality with
    clean albedo and normal removes nearly all of it: at 50 samples per pixel this is far easier than at one. An
    anti-aliased reference was rendered with its own features. Use the result for training only; errors are measured
    against references as rendered.

    Args:
        source: file of the take, or folder of the sequence. If features of a sequence have noise, this noise will be in
            the references.
        out: folder for the copy. A finished copy of what the source holds now is kept; an older one is made anew.

    Returns:
        The copy, ``out/NAME``.

    Raises:
        InputError: the optional package pyoidn is missing, a file is damaged, a take has no error of its references,
            the copy cannot be written, or something else is in its place.
    """
    if find_shards(source) == [source]:
        return _clean_take(source, out / source.name)
    oidn = create_model("oidn", quality="high", auxiliary="clean")
    sequence = open_sequence(source)
    inputs = source / "inputs" if (source / "inputs").is_dir() else source
    copied = out / sequence.name / "inputs"
    # Written last, as a sign that the copy is complete.
    description, checksum = copied / "camera.json", _checksum(inputs)
    found = json.loads(read_text(description)) if description.exists() else {}
    if _is_copy(found, checksum, copied):
        return copied.parent
    if copied.exists() and copied.samefile(inputs):
        raise InputError(f"{out}: expected another folder than that of the sequence, found the same")
    if found:
        # Also frames that the sequence no longer has.
        shutil.rmtree(copied)
    ignored = shutil.ignore_patterns("reference*.exr", description.name, ".*")
    shutil.copytree(inputs, copied, ignore=ignored, dirs_exist_ok=True)
    if (owed := source / "credits.txt").is_file():
        shutil.copy(owed, copied.parent)
    for number in sequence.reference_numbers:
        frame, _ = sequence.frame(number).validate()
        if frame.reference is None:
            continue
        features = read_clean_features(inputs, number) or (frame.albedo, frame.normal)
        image = oidn(Frame(color=frame.reference, albedo=features[0], normal=features[1]))[0].image
        # The filter may return negative radiance.
        pixels = image[0].clamp(0, 65504).permute(1, 2, 0).numpy()
        write_exr(copied / f"reference{number}.exr", pixels, ["R", "G", "B"])
    rendered = inputs / description.name
    about = json.loads(read_text(rendered)) if rendered.exists() else {}
    # Remove statements about the references that no longer hold, so that no renderer refines them as means of paths.
    about = {key: value for key, value in about.items() if key not in ("reference_spp", "reference_noise")}
    about |= {_FILTER: "Open Image Denoise, high, clean aux", _SOURCE: checksum}
    write_text(description, json.dumps(about) + "\n")
    return copied.parent


def _is_copy(found: Mapping[str, Any], checksum: str, place: Path) -> bool:
    """Whether a finished copy, by its description, is one of this content; one of other content may be replaced."""
    if found and _FILTER not in found:
        raise InputError(f"{place}: expected a copy with clean references, found something else; choose another folder")
    return found.get(_SOURCE) == checksum


def _checksum(folder: Path) -> str:
    """That of all files of a sequence but hidden ones, which are temporary files of a renderer."""
    whole = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("[!.]*") if path.is_file()):
        whole.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return whole.hexdigest()


def _clean_take(source: Path, out: Path) -> Path:
    """Copy a packed take with clean references, and without their error."""
    shard = open_shard(source)
    if out.exists() and _is_copy(open_shard(out).header, shard.digest, out):
        return out
    if ERROR not in shard.shapes:
        raise InputError(f"{source}: expected a take with {ERROR}, which tells its halves, found none; render it anew")
    arrays: dict[str, Any] = shard.read()
    last: dict[str, Any] = {
        name: torch.from_numpy(arrays[name][-shard.references :].astype(np.float32))
        for name in ("albedo", "normal", "reference", ERROR)
        if name in arrays
    }
    mean, error = last.pop("reference"), last.pop(ERROR)
    oidn = Oidn("high", "clean")
    guides = oidn.with_clean_features(Frame(color=mean, **last), "high")

    def denoise(image: Tensor) -> Tensor:
        return oidn.denoised(guides.replace(color=image), "clean").clamp_min(0)

    arrays["reference"] = cleaned((mean + error).clamp_min(0), (mean - error).clamp_min(0), denoise).numpy()
    del arrays[ERROR]
    out.parent.mkdir(parents=True, exist_ok=True)
    own = {_FILTER: "Open Image Denoise, as far as two halves agree", _SOURCE: shard.digest}
    write_shard(out, {**shard.header, **own}, arrays)
    return out
