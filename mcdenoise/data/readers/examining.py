"""Determining what the values of a shot's files mean, from a few frames."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from mcdenoise.data.camera_matrices import MATRICES
from mcdenoise.data.images import Image, Mask
from mcdenoise.data.readers.cameras import FittedCamera, fault, fit_camera
from mcdenoise.data.readers.diffuse_specular import SPECULAR_ALBEDO, Split
from mcdenoise.data.readers.files import RenderedFiles, world_to_camera
from mcdenoise.data.readers.layers import Layer
from mcdenoise.data.readers.lights import is_same
from mcdenoise.data.readers.samples import SampleLayers, mean_is
from mcdenoise.data.readers.values import Row, normal_is_encoded, nothing_hit, read_radiance
from mcdenoise.motion import MOTION_PAIRS, USUAL_MOTION, Array, Convention, motion_to, read_as, read_motion
from mcdenoise.noise import noise_is_spread
from mcdenoise.ops import use

# Motion conventions known by layer name: Blender's points to the previous frame, in pixels, y up.
_MOTION = {"vector": Convention(1, -1, "previous - current, y up, pixels")}
# Smallest motion in pixels that shows a moving camera.
_MOVED = 0.3
# Largest distance of a camera from the origin, relative to the distance of visible points, in camera space.
_ORIGIN = 1e-2


def examine(shot: RenderedFiles, color_has_albedo: bool | None) -> dict[str, Image]:
    """Determine what the values of the examined frame mean, and of the next ones if there is motion.

    Returns:
        The images of that frame.
    """
    number, chosen = shot.examined, dict(shot.choice.layers)
    images = shot.read_buffers(number, [n for n in chosen if n != "reference" or number in shot.reference_numbers])
    readings = {name: [shot.choice.reasons[name]] if name in shot.choice.reasons else [] for name in images}
    _examine_color(shot, images, readings["color"], color_has_albedo)
    if "albedo" in images:
        above = float((np.nan_to_num(images["albedo"]) > 1).any(-1).mean())
        readings["albedo"].append(f"{above:.1%} of the pixels above 1, clamped" if above else "0 to 1")
    if "normal" in images:
        shot.encoded_normals = normal_is_encoded(images["normal"])
        readings["normal"].append("stored as n/2 + 1/2, decoded" if shot.encoded_normals else "signed")
        length = np.linalg.norm(
            np.nan_to_num(images["normal"]) * (2 if shot.encoded_normals else 1) - shot.encoded_normals, axis=-1
        )
        if not 0.5 < np.median(length[length > 0.05] if (length > 0.05).any() else [1.0]) < 1.5:
            shot.warnings.append("'normal': most have no unit length; is it a normal? leave it out with --map normal=")
    if "depth" in images:
        far = nothing_hit(images["depth"])
        if far.all():
            behind = nothing_hit(-images["depth"])
            # A single value may be a placeholder.
            if np.unique(images["depth"][~behind]).size > 1:
                shot.negative_depths, images["depth"], far = True, -images["depth"], behind
                readings["depth"].append("all negative: negated")
        what = (
            "background: none"
            if not far.any()
            else f"background: {far.mean():.0%}, {_span(images['depth'][far])}, read as infinity"
        )
        readings["depth"].append(what)
    if "position" in images:
        _examine_positions(shot, images, readings)
    elif shot.cameras is not None:
        readings["view_projection"] = ["no positions to check it with"]
    if "motion" in images:
        shot.motion, said = _motion(shot, images)
        readings["motion"].append(said)
    for name, words in readings.items():
        layer = chosen.get(name)
        source = layer.place if layer else MATRICES if shot.cameras else "the positions"
        shot.table.append(Row(name, source, "; ".join(words)))
    for light in shot.lights.values():
        layer, *colors = light.layers
        shot.table.append(Row("layer", layer.place, f"times {colors[0]}" if colors else "light"))
    return images


def _examine_color(shot: RenderedFiles, images: Mapping[str, Image], words: list[str], stated: bool | None) -> None:
    if shot.part_of(shot.choice.layers["color"]).display_referred:
        words.append("display values, made linear")
        shot.warnings.append(
            "'color': 8 or 16 bits of display values: what was brighter than white is lost; render floats, or say "
            "--input-linear if its numbers are linear"
        )
    albedo = np.clip(np.nan_to_num(images["albedo"]), 0, 1) if "albedo" in images else None
    guides = [None if each is None else _view(each) for each in (albedo, images.get("normal"))]
    # Once a shot: to load the compiled form would take longer than plain torch does.
    with use("torch"):
        spread = noise_is_spread(_view(images["color"]), *guides)
    if spread:
        shot.warnings.append(
            "'color': neighbouring pixels share noise, since the film's filter counts each sample in several of them, "
            "as Mitsuba's default does; most denoisers, and OIDN most of all, leave such noise in: render with a box "
            "filter, or use the models wild, wild_large or oidn_temporal"
        )
    if albedo is None:
        words.append("radiance")
        return
    reference = images["reference"][..., :3] if "reference" in images else None
    shot.color_has_albedo, said, warning = read_radiance(images["color"][..., :3], albedo, reference, stated)
    words.append(said)
    shot.warnings += warning


def _examine_positions(shot: RenderedFiles, images: dict[str, Image], readings: dict[str, list[str]]) -> None:
    position, known = images["position"], shot.known(images)
    if shot.cameras is not None:
        stated = shot.cameras.view_projection(shot.examined, shot.size)
        said = _examine_cameras(shot, stated, position, known)
        if shot.has_camera or not shot.fits_cameras:
            readings["view_projection"] = [said]
    if shot.has_camera or not shot.fits_cameras:
        return
    shot.cameras = None
    found = fit_camera(position, known)
    if found is None:
        readings["position"].append("not used without a camera")
        shot.drops_positions = True
        if len(shot.numbers) > 1:
            shot.warnings.append(
                f"'position': they tell no pinhole camera, as points of one plane do not, and there is no {MATRICES}: "
                "not used; write that file, or motion"
            )
    elif not shot.positions_of_camera and _is_origin(found, position, known) and _ends_at_origin(shot):
        if world_to_camera(shot.metadata(shot.examined)) is not None:
            shot.positions_of_camera = True
            images["position"] = shot.in_world(shot.examined, images["position"])
            readings["position"].append("in the space of the camera, brought to the world by 'worldToCamera'")
            _examine_positions(shot, images, readings)
            return
        # The previous positions of points are unknown.
        shot.drops_positions, shot.has_camera = True, "depth" not in images
        readings["position"].append("in the space of the camera: only its depth is used")
    else:
        shot.has_camera = True
        said = f"found from the positions, which it sees {found.error:.2g} pixels from their own"
        readings["view_projection"] = [said]


def _examine_cameras(shot: RenderedFiles, stated: Array, position: Image, known: Mask) -> str:
    """Determine how given matrices are stored, in words; unless they see the positions there is no camera."""
    shot.camera_convention, error = read_as(stated, position, known)
    shot.has_camera = shot.camera_convention != "unknown"
    how = shot.camera_convention or "row vectors, y down"
    if not shot.has_camera:
        seen = f"does not see the positions at their pixels (they miss by {error:.0f}) whichever way it is read"
        instead = "cameras are found from the positions instead" if shot.fits_cameras else "no history is found"
        shot.warnings.append(f"{MATRICES}, frame {shot.examined}: {fault(stated) or seen}; {instead}")
    elif shot.camera_convention:
        shot.warnings.append(f"{MATRICES}: read as {how}, since only so it sees the positions at their pixels")
    return f"{how}: positions are seen {error:.2g} pixels from their own"


def _is_origin(camera: FittedCamera, position: Image, known: Mask) -> bool:
    """Whether a camera fitted to positions is at their origin."""
    distance = np.linalg.norm(position[known], axis=-1)
    return bool(np.linalg.norm(camera.eye) < _ORIGIN * np.median(distance))


def _ends_at_origin(shot: RenderedFiles) -> bool:
    """Whether the last frame's camera is also at the origin: one that moves in the world may have begun there."""
    images = shot.read_buffers(shot.numbers[-1], {"position", "depth"} & shot.choice.layers.keys())
    known = shot.known(images)
    found = fit_camera(images["position"], known)
    return found is not None and _is_origin(found, images["position"], known)


def _view(image: Image) -> Tensor:
    """``(1, 3, H, W)`` of the first three channels of ``(H, W, C)``; copies would take more memory than a denoiser."""
    return torch.from_numpy(image[..., :3]).permute(2, 0, 1)[None]


def _motion(shot: RenderedFiles, first: Mapping[str, Image]) -> tuple[Convention, str]:
    """Determine the convention of the motion by comparing consecutive frames; motion that is all zero is removed."""
    layer = shot.choice.layers["motion"]
    given = _MOTION.get(layer.title.lower(), USUAL_MOTION)
    kept = {"albedo", "normal"} & set(shot.choice.layers) or {"color"}
    pairs, seen_elsewhere = [], []
    following = [(a, b) for a, b in pairwise(shot.numbers) if b == a + 1 and a >= shot.examined][:MOTION_PAIRS]
    names = kept | {"motion"} | ({"position", "depth"} & set(shot.choice.layers))
    last, images = shot.examined, first
    for before, now in following:
        previous = images if last == before else shot.read_buffers(before, names)
        last, images = now, shot.read_buffers(now, names)
        elsewhere = _seen_elsewhere(shot, (before, previous), (now, images))
        if elsewhere is not None:
            seen_elsewhere.append((images["motion"], elsewhere))
        features, earlier = (
            {name: np.clip(np.nan_to_num(each[name][..., :3]), -1, 1) for name in kept} for each in (images, previous)
        )
        pairs.append((features, earlier, images["motion"]))
    moved = any(np.nanmedian(np.linalg.norm(seen, axis=-1)) > _MOVED for _, seen in seen_elsewhere)
    if moved and not any(given.moves(motion, 0) for *_, motion in pairs):
        del shot.choice.layers["motion"]
        shot.warnings.append(
            "'motion': all zeros although the camera moves, as Blender writes it with motion blur; positions are used "
            "instead"
        )
        return given, "all zeros: not used"
    chosen, words, warnings = read_motion(pairs, given, seen_elsewhere)
    shot.warnings += warnings
    if chosen is None:
        del shot.choice.layers["motion"]
    return chosen or given, words


def _seen_elsewhere(
    shot: RenderedFiles, before: tuple[int, Mapping[str, Image]], now: tuple[int, Mapping[str, Image]]
) -> Array | None:
    """Pixels from each point of a frame to its projection by the previous frame's camera, if both are known."""
    if not shot.has_camera:
        return None
    matrix, known = shot.camera(*before), shot.known(now[1])
    if matrix is None or not known.any():
        return None
    return motion_to(matrix, now[1]["position"], known)


def examine_parts(
    shot: RenderedFiles,
    color: Image,
    splits: Sequence[Split],
    samples: SampleLayers,
    everywhere: Collection[Layer],
) -> None:
    """Use parts of the light and samples that every frame has, if the examined frame's add up to its color.

    Args:
        shot: the files.
        color: ``(H, W, 3)`` of the examined frame, as stored.
        splits: candidates; the first one that adds up is used.
        samples: the layers of samples.
        everywhere: those of these layers that every frame has, with the pixels of the color.
    """
    refused: list[tuple[Split, float, float]] = []
    for split in (each for each in splits if shot.color_has_albedo and each.layers <= {*everywhere}):
        pixels = shot.read(shot.examined, split.layers)
        sums = split.sums(pixels)
        far = split.difference(sums, color)
        if not is_same(far):
            refused.append((split, far, _light(*sums.values()) / (_light(color) or 1)))
            split = split.without_absent_light(pixels, color)
            sums = split.sums(pixels)
            if not is_same(split.difference(sums, color)):
                continue
        shot.split = split
        total = _light(*sums.values()) or 1
        for name, lights in split.parts.items():
            own = [light.layers[0] for light in lights]
            places = [own[0].place, *(each.title if each.files == own[0].files else each.place for each in own[1:])]
            colors = list(dict.fromkeys(light.color.title for light in lights if light.color is not None))
            said = f"{_light(sums[name]) / total:.0%} of the light; the parts add up to the color"
            shot.table.append(Row(name, ", ".join(places), f"times {', '.join(colors)}; {said}" if colors else said))
        if split.specular_albedo is not None:
            shot.table.append(Row(SPECULAR_ALBEDO, split.specular_albedo.place, "clamped to 0 to 1"))
        break
    else:
        for split, far, light in refused[:1]:
            found = ", ".join(each.layers[0].title for own in split.parts.values() for each in own)
            why = f"render {', '.join(split.absent)}, too, where the scene has such light" if split.absent else ""
            why = why or "they are of another image, or stored with loss (DWA), or the color has been denoised"
            shot.warnings.append(
                f"'diffuse', 'specular': {found} have {light:.1%} of the light of the color and differ from it in "
                f"{far:.0%} of the pixels: not used; {why}"
            )
    if not samples.radiance:
        return
    if not samples.layers <= {*everywhere}:
        shot.warnings.append("'samples': some frames have others, or of other pixels, or none: not used")
    elif not mean_is(color, samples.samples(shot.read(shot.examined, samples.layers))):
        shot.warnings.append(
            f"'samples': the mean of {len(samples.radiance)} is not the color: not used; write all samples of a pixel, "
            "with the weights of the pixel filter in them"
        )
    else:
        shot.samples = samples
        shot.table.append(Row("samples", f"{samples.radiance[0].place} and on", str(samples)))


def _light(*images: Image) -> float:
    """The sum of all finite values."""
    return sum(float(image[np.isfinite(image)].sum(dtype=np.float64)) for image in images)


def _span(values: Image) -> str:
    known = values[np.isfinite(values)]
    if not known.size:
        return "not finite"
    low, high = float(known.min()), float(known.max())
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
