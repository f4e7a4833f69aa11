"""The one way to compile: `@kernel(signature)`.

numba's own cache looks at the file of the function it compiled, not at the files of the functions which that one calls; it
would go on serving old physics after a callee in another file changed. So every kernel is cached in a folder whose name is
a hash of all sources of the package, the numba and numpy versions and the CPU: any change makes a new folder.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import llvmlite.binding as llvm
import numba
import numpy as np
from numba import types

_numba_config: Any = numba.config  # its attributes are made at import; the type checker sees none

F = TypeVar("F", bound=Callable[..., Any])

PACKAGE = Path(__file__).resolve().parent.parent
KERNEL_ROOMS = ("wire", "dynamics", "devices", "plant", "controller", "offline")


def sources(package: Path = PACKAGE) -> list[Path]:
    """All files a kernel's meaning can depend on: Python sources and messages of the rooms with kernels."""
    found = (p for room in KERNEL_ROOMS for end in ("*.py", "*.msg") for p in (package / room).rglob(end))
    return sorted(found)


def source_hash(files: list[Path]) -> str:
    """A hash of names and contents of `files`, numba's and numpy's versions and the CPU."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    cpu = f"{llvm.get_host_cpu_name()} {llvm.get_host_cpu_features().flatten()}"
    digest.update(f"{numba.__version__} {np.__version__} {cpu}".encode())
    return digest.hexdigest()[:16]


def cache_root() -> Path:
    """Where compiled kernels are kept: `$XDG_CACHE_HOME` or `~/.cache`, in a folder of ours."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "softloop" / "kernels"


CACHE_DIR = cache_root() / source_hash(sources())


def kernel(*signatures: Any) -> Callable[[F], F]:
    """Compile a pure function for the given explicit signature(s), cached as this module's text says.

    No fastmath, no parallel: equal inputs give equal bytes (within one installation). Division by zero gives inf or nan,
    as in numpy. With `NUMBA_DISABLE_JIT=1` (numba's own switch) the plain function is returned.
    """

    def decorate(function: F) -> F:
        before = _numba_config.CACHE_DIR
        _numba_config.CACHE_DIR = str(CACHE_DIR)
        try:
            compiled = numba.njit(list(signatures), cache=True, nogil=True, error_model="numpy", fastmath=False)(function)
        finally:
            _numba_config.CACHE_DIR = before
        return cast(F, compiled)

    return decorate


def record_dtype(fields: list[Any]) -> np.dtype[Any]:
    """An aligned record dtype whose elements have attributes, in numpy and in kernels alike."""
    return np.dtype((np.record, np.dtype(fields, align=True)))


def record_type(dtype: np.dtype[Any]) -> Any:
    """The numba type of one record of `dtype`, for a kernel's signature."""
    return numba.from_dtype(dtype)


def array_of(element: Any, dimensions: int = 1, layout: Literal["C", "A"] = "C") -> Any:
    """The numba type of an array of `element`; layout "A" also takes an array that is a field of a record."""
    return types.Array(element, dimensions, layout)


def new_record(dtype: np.dtype[Any]) -> Any:
    """One zeroed record of `dtype`, writable in place."""
    return np.zeros(1, dtype)[0]
