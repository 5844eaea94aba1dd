"""`mcdenoise render`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from mcdenoise.cli._options import Flag, Out, Workers, parse_size
from mcdenoise.cli._output import say, steps_of
from mcdenoise.data.sequences import parse_frames
from mcdenoise.engines import RayEngine, parse_workers
from mcdenoise.errors import InputError
from mcdenoise.scenes.render import choose_variant, load_camera_path, render_sequence


@dataclass(frozen=True)
class RenderOptions:
    """How a sequence is rendered, whatever the scene.

    Args:
        spp: samples a pixel of the noisy color.
        noise_seeds: noisy colors of each frame, each with a noise seed of its own.
        reference_spp: samples a pixel of the references; 0 renders none.
        reference_frames: frames that get a reference, such as 8-11; all by default.
        size: WIDTHxHEIGHT in pixels.
        workers: processes that render side by side, of use with scalar_rgb; or the address of a Ray cluster, such as
            auto, 10.0.0.1:6379, or local for one on this machine, all machines of which see the same folders.
        variant: Mitsuba variant, such as scalar_rgb or llvm_ad_rgb; the fastest that works by default.
    """

    spp: int = 1
    noise_seeds: int = 1
    reference_spp: int = 512
    reference_frames: str | None = None
    size: str = "640x360"
    workers: Workers = "1"
    variant: str | None = None

    def arguments(self) -> dict[str, Any]:
        """Those of ``render_sequence``."""
        frames = self.reference_frames
        return {
            **vars(self),
            "reference_frames": None if frames is None else parse_frames(frames, name="--reference-frames"),
            "size": parse_size(self.size),
            "workers": parse_workers(self.workers) or 1,
        }


def render(
    scene: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="SCENE")]],
    camera_path: Path,
    out: Out,
    rendering: tyro.conf.OmitArgPrefixes[RenderOptions],
    frames: int | None = None,
    every: int = 1,
    seed: int = 0,
    noise_level: float | None = None,
    keep_samples: Flag = False,
) -> None:
    """Render a Mitsuba 3 scene along a camera path to a sequence in the BMFR layout.

    The same command again resumes a run that was stopped; with more samples or less noise it refines references.

    Args:
        scene: Mitsuba 3 scene.xml.
        camera_path: JSON with 'fov' in degrees, and a list 'to_world' of 4x4 camera-to-world matrices or a list
            'frames' of cameras with 'position' and 'look_at'; or a folder of Tungsten scenes, one per frame.
            Objects of the scene move with 'objects': for each id a list of 4x4 matrices, one per frame.
        out: folder of the sequence; finished frames in it are kept.
        rendering: samples, references, size and processors.
        frames: render the first so many cameras; all by default.
        every: take only every n-th camera of the path.
        seed: seed of the noise.
        noise_level: refine each reference until its estimated SMAPE is this small, such as 0.02, or has
            --reference-spp samples.
        keep_samples: also write the single samples of the noisy colors, for methods such as sbmc and layered.
    """
    if every < 1:
        raise InputError(f"--every: expected at least 1, found {every}")
    arguments = rendering.arguments()
    shot = load_camera_path(camera_path)
    engine = None
    if parse_workers(rendering.workers) is None:
        # Workers have other working folders.
        scene, out = Path(os.path.abspath(scene)), Path(os.path.abspath(out))
        arguments["variant"] = choose_variant(rendering.variant)
        engine = RayEngine(rendering.workers, gpus=float(arguments["variant"].startswith("cuda")))
    with steps_of("render") as on_step:
        written = render_sequence(
            scene,
            shot.cameras[::every],
            out,
            engine=engine,
            frames=frames,
            moves={name: path[::every] for name, path in shot.moves.items()},
            seed=seed,
            noise_level=noise_level,
            keep_samples=keep_samples,
            progress=on_step,
            **arguments,
        )
    say(written)
