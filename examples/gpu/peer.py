"""Time Open Image Denoise on the same GPU, on images that are there already: the optional package pyoidn.

python examples/gpu/peer.py -o peer.json
"""

from functools import partial

import torch
from part import SIZES, Part, shot

from mcdenoise.errors import InputError

QUALITIES = ("fast", "balanced", "high")
IMAGES = ("color", "albedo", "normal")


def times(part: Part, size: tuple[int, int], quality: str) -> dict[str, object]:
    """The time of the library's filter of HDR color with albedo and normal, without one that denoises these first."""
    try:
        import pyoidn
    except ImportError as error:
        raise InputError(f"pyoidn: expected the package for this part, found none ({error})") from error
    frame = shot(1, *size)[0].to(part.device)
    images = {name: frame.buffer(name)[0].permute(1, 2, 0).contiguous() for name in IMAGES}
    images["output"] = torch.zeros_like(images["color"])
    # It works in torch's stream, and reads and writes the memory of torch's tensors.
    device = pyoidn.Device.from_torch(part.device)
    device.commit()
    run = pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT)
    for name, image in images.items():
        run.set_image(name, image, pyoidn.OIDN_FORMAT_FLOAT3)
    run.set_bool("hdr", True)
    run.set_quality(getattr(pyoidn, f"OIDN_QUALITY_{quality.upper()}"))
    run.commit()
    found = part.milliseconds(run.execute_async if part.device.type == "cuda" else run.execute)
    device.wait()
    if message := device.get_error():
        raise RuntimeError(f"Open Image Denoise: {message}")
    mean = float(images["output"].mean() / images["color"].mean())
    run.release()
    device.release()
    return {**found, "images": "in the memory of the device", "brightness of the result": round(mean, 4)}


def main() -> None:
    part = Part.begin(__doc__)
    for size in ((64, 48),) if part.quick else SIZES:
        for quality in QUALITIES:
            measure = partial(times, part, size, quality)
            part.attempt(f"Open Image Denoise, {quality}, {size[0]}x{size[1]}", measure)


if __name__ == "__main__":
    main()
