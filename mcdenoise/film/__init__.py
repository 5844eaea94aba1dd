"""Films: many shots, denoised by many processes or machines, with nothing lost.

The driver (`driver`) schedules tasks (`work`) on an engine (:mod:`mcdenoise.engines`): they look at a shot, and denoise
pieces of it. Workers read and write the disks themselves, and record each finished frame. Driver and workers may be
killed at any time: the next run finds the finished frames again.
"""

from mcdenoise.film.driver import ShotResult, run_film, write_page
from mcdenoise.film.manifest import Shot, read_film

__all__ = ["Shot", "ShotResult", "read_film", "run_film", "write_page"]
