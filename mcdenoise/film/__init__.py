"""Films: many shots, denoised by many processes or machines, with nothing lost.

Each shot is scanned, denoised and summarized by tasks (`work`), which any worker on any machine can run: workers read
and write the disks themselves, and record each finished frame beside its result (`record`). The driver (`driver`)
schedules the tasks on an engine (:mod:`mcdenoise.engines`). Driver and workers may be killed at any time: the next run
finds the finished frames again.
"""

from mcdenoise.film.driver import Film, FilmResult, ShotResult, run_film
from mcdenoise.film.manifest import Shot, read_film
from mcdenoise.film.page import write_page

__all__ = [
    "Film",
    "FilmResult",
    "Shot",
    "ShotResult",
    "read_film",
    "run_film",
    "write_page",
]
