"""Files in and out: EXR images, and sequences of frames in known folder layouts."""

from mcdenoise.data.exr import read_exr, write_exr
from mcdenoise.data.sequences import Sequence, open_sequence

__all__ = ["Sequence", "open_sequence", "read_exr", "write_exr"]
