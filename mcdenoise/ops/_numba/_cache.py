"""Compiled code that is kept from run to run: verified before it is used, and never needed."""

from __future__ import annotations

import hashlib
import os
import pickle
import secrets
import stat
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache
from numba.core.serialize import dumps

_DIGEST = hashlib.sha256
# Object code of one kernel takes some hundred KB.
_LARGEST = 64 << 20
# Age in seconds after which a temporary file is abandoned.
_ABANDONED = 3600.0


class VerifiedCache(FunctionCache):
    """Numba's cache with one file for each signature, of which nothing is unpickled or run before its digest is right.

    Numba trusts its files and the disk: one that is cut off is an exception in every run, one with a flipped bit ends
    the process in LLVM or in the kernel, and a full disk is an exception, too. Here each of these means that the kernel
    is compiled, and its file written again where that is possible. Two processes that write at once cannot mix what
    belongs to two signatures either, as they can with numba's index.
    """

    def flush(self) -> None:
        """Remove all compiled code of this function from the cache."""
        for path in Path(self._cache_path).glob(f"{self._impl.filename_base}.*.nbc"):
            with suppress(OSError):
                path.unlink()

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        key = self._index_key(sig, target_context.codegen())  # type: ignore[no-untyped-call]
        path = self._path(key)
        try:
            content = _read(path)
            if content[: _DIGEST().digest_size] != self._digest(path, content[_DIGEST().digest_size :]):
                return None
            # Two keys may be spelled alike.
            found, reduced = pickle.loads(content[_DIGEST().digest_size :])
            return self._impl.rebuild(target_context, reduced) if found == key else None
        except Exception:  # whatever may be wrong with a file: it is only a cache
            return None

    def _save_overload(self, sig: Any, data: Any) -> None:
        if not self._impl.check_cachable(data):
            return
        key = self._index_key(sig, data.codegen)  # type: ignore[no-untyped-call]
        path, content = self._path(key), dumps((key, self._impl.reduce(data)))  # type: ignore[no-untyped-call]
        with suppress(OSError):
            self._impl.locator.ensure_cache_path()
            _write(path, self._digest(path, content) + content)

    def _path(self, key: Any) -> Path:
        name = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        return Path(self._cache_path, f"{self._impl.filename_base}.{name}.nbc")

    def _digest(self, path: Path, content: bytes) -> bytes:
        # The digest covers version, source and name, so that a file of any other one does not match.
        made = repr((numba.__version__, self._impl.locator.get_source_stamp(), path.name))
        return _DIGEST(made.encode() + b"\0" + content).digest()


def _read(path: Path) -> bytes:
    # Opening a pipe of this name would block until another process writes into it.
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with os.fdopen(handle, "rb") as file:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode) or status.st_size > _LARGEST:
            raise OSError(f"{path} is no file of a cache")
        return file.read(_LARGEST)


def _write(path: Path, content: bytes) -> None:
    """Write a file that has its name only when it is whole."""
    temporary = path.with_name(f"{path.name}.tmp.{secrets.token_hex(8)}")
    try:
        with open(temporary, "xb") as file:
            file.write(content)
        os.replace(temporary, path)
        # A process killed while it writes leaves its file; the next one to compile the kernel comes here.
        for other in path.parent.glob(f"{path.name}.tmp.*"):
            if time.time() - other.stat().st_mtime > _ABANDONED:
                other.unlink()
    finally:
        # Gone already if all went well.
        with suppress(OSError):
            os.unlink(temporary)
