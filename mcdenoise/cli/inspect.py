"""`mcdenoise inspect`."""

from __future__ import annotations

from mcdenoise.cli._options import Flag, Inputs, Json, Map
from mcdenoise.cli._output import print_rows, warn, write_json
from mcdenoise.data import Sequence
from mcdenoise.data.readers.diffuse_specular import LIGHT_PARTS
from mcdenoise.errors import printable
from mcdenoise.shot import ShotSettings


def inspect(
    inputs: Inputs,
    frames: str | None = None,
    map: Map = (),
    color_without_albedo: Flag = False,
    color_with_albedo: Flag = False,
    input_linear: Flag = False,
    json: Json = None,
) -> None:
    """Show from which layers the buffers of a shot would be read, how, and why, without denoising.

    Args:
        inputs: a folder; files; or a pattern, as for `mcdenoise denoise`.
        frames: frames to inspect, such as 0-59,70; all by default.
        map: layer of a buffer that is not recognized by name, such as albedo=RGBA.diff; 'motion=' for none.
        color_without_albedo: the noisy color was divided by the albedo.
        color_with_albedo: the noisy color was not divided by the albedo.
        input_linear: the numbers of TIFF and PNG files are linear radiance; by default what the files say.
        json: write the printed figures to this file too.
    """
    shot = ShotSettings(
        frames=frames,
        map=map,
        color_without_albedo=color_without_albedo,
        color_with_albedo=color_with_albedo,
        input_linear=input_linear,
    )
    opened = shot.open(inputs)
    print_sequence(opened)
    used = _users(opened)
    for buffer, models in used.items():
        print(f"{buffer}: of use to {', '.join(models) or 'no model of the zoo'}")
    write_json(
        json,
        {
            "name": opened.name,
            "layout": opened.layout,
            "frames": opened.numbers,
            "size": list(opened.size),
            "buffers": sorted(opened.buffers),
            "read": [row._asdict() for row in opened.table],
            "of_use_to": used,
            "unused": list(opened.unused),
            "warnings": list(opened.warnings),
        },
    )


def _users(sequence: Sequence) -> dict[str, list[str]]:
    """For the buffers that few models use, parts of the light and samples, the models that use them."""
    if not (found := sorted(LIGHT_PARTS & sequence.buffers)):
        return {}
    # Imported here because it imports every model, which is slow.
    from mcdenoise.models._overview import users_of

    return users_of(found)


def print_sequence(sequence: Sequence) -> None:
    """Print the layout and the frames of a sequence, the layer of each buffer, and warnings."""
    height, width = sequence.size
    numbers = sequence.numbers
    frames = f"frame {numbers[0]}" if len(numbers) == 1 else f"{len(numbers)} frames, {numbers[0]} to {numbers[-1]},"
    print(f"{printable(sequence.name)}: {sequence.layout} layout, {frames} of {width}x{height}")
    print_rows([{"buffer": row.buffer, "taken from": row.source, "read as": row.reading} for row in sequence.table])
    if sequence.unused:
        print(f"not used: {printable(', '.join(sequence.unused))}")
    if sequence.unknown:
        names = printable(", ".join(sequence.unknown))
        print(f"unknown: {names}; read them with --map BUFFER=LAYER or --layers LAYER")
    warn(*sequence.warnings)
