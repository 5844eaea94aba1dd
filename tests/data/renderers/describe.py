"""Print what EXR files hold: parts, layers with their channels, types and compression, least and largest values.

python describe.py blender/shot_0001.exr luxcore/*_0001.exr
"""

import sys
from itertools import groupby

import numpy as np
import OpenImageIO


def main():
    for path in sys.argv[1:]:
        source = OpenImageIO.ImageInput.open(path)
        if source is None:
            sys.exit(f"{path}: {OpenImageIO.geterror()}")
        print(path)
        part = 0
        while source.seek_subimage(part, 0):
            spec = source.spec()
            name = spec.getattribute("oiio:subimagename")
            print(f"  part {name or part}: {spec.width}x{spec.height} {spec.getattribute('compression')}")
            types = [str(kind) for kind in spec.channelformats or [spec.format] * spec.nchannels]
            values = np.asarray(source.read_image(part, 0, 0, spec.nchannels, "float"))
            layers = [(label.rpartition(".")[0], kind) for label, kind in zip(spec.channelnames, types, strict=True)]
            for (layer, kind), channels in groupby(range(spec.nchannels), layers.__getitem__):
                chosen = list(channels)
                names = ",".join(spec.channelnames[channel].rpartition(".")[2] for channel in chosen)
                low, high = values[..., chosen].min(), values[..., chosen].max()
                label = f"{layer}.{names}" if layer else names
                print(f"    {label:38} {kind:5} {low:10.4g} .. {high:.4g}")
            part += 1
        source.close()


if __name__ == "__main__":
    main()
