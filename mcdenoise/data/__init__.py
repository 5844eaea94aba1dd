"""Reading and writing files: EXR images, and sequences of frames."""

from mcdenoise.data.exr import read_exr, write_exr
from mcdenoise.data.readers.sequence import Sequence
from mcdenoise.data.sequences import open_sequence

__all__ = ["Sequence", "open_sequence", "read_exr", "write_exr"]
