"""Pieces of a shot: the frames that one worker writes, and the frames before them that give them their history."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Piece:
    """Frames that one worker denoises, one after the other.

    Args:
        numbers: of all frames of the piece, ascending.
        wanted: of the frames that are written; the others only give them their history.
    """

    numbers: tuple[int, ...]
    wanted: tuple[int, ...]


def cut(numbers: Sequence[int], missing: Collection[int], length: int, overlap: int | None) -> list[Piece]:
    """Cut a shot into pieces of equal length, and take the missing frames of each.

    The boundaries depend on the shot alone, not on the missing frames or the workers. A piece begins ``overlap`` frames
    before the first frame that it writes. An interrupted piece resumes ``overlap`` frames before its first missing
    frame; or at its own first frame, with exactly the same result, where that is at most twice as far.

    Args:
        numbers: of all frames of the shot, ascending.
        missing: numbers of the frames to be written.
        length: largest number of frames in a piece; 0 does not cut the shot.
        overlap: number of frames that the method remembers; ``None`` if its history has no known length: the shot is
            not cut, and every frame is computed after all frames before it.

    Returns:
        The pieces in order; none where no frame is missing.

    Example:
        >>> for piece in cut(range(12), range(3, 12), length=6, overlap=2):
        ...     print(piece.numbers, piece.wanted)
        (0, 1, 2, 3, 4, 5) (3, 4, 5)
        (4, 5, 6, 7, 8, 9, 10, 11) (6, 7, 8, 9, 10, 11)
    """
    numbers, missing = list(numbers), set(missing)
    count = 1 if overlap is None or length < 1 else -(-len(numbers) // length)
    ends = [len(numbers) * (part + 1) // count for part in range(count)]
    pieces: list[Piece] = []
    for first, end in zip([0, *ends], ends, strict=False):
        begin = 0 if overlap is None else max(0, first - overlap)
        own: list[range] = []
        for place in range(first, end):
            if numbers[place] not in missing:
                continue
            start = begin if overlap is None or place - begin <= 2 * overlap else place - overlap
            # One longer piece costs no more than another overlap.
            if own and start <= own[-1].stop:
                start = own.pop().start
            own.append(range(start, place + 1))
        for places in own:
            computed = tuple(numbers[place] for place in places)
            pieces.append(Piece(computed, tuple(n for n in computed if n in missing and numbers[first] <= n)))
    return pieces
