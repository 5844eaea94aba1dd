"""Reading and writing files: EXR images, and sequences of frames."""

from mcdenoise.data.exr import read_exr, write_exr
from mcdenoise.data.sequences import Sequence, open_sequence

__all__ = ["Sequence", "open_sequence", "read_exr", "write_exr"]
