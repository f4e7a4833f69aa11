"""The one way to compile: `@kernel(signature)`.

numba's own cache looks at the file of the function it compiled, not at the files of the functions which that one calls; it
would go on serving old physics after a callee in another file changed. So the kernels of a module are cached in a folder whose
name is a hash of all sources that the module can reach by imports, of all messages, the numba and numpy versions and the CPU:
a change of any of them makes a new folder, and a change of what a kernel cannot reach leaves it compiled.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import llvmlite.binding as llvm
import numba
import numpy as np
from numba import types

from softloop.wire.errors import Unavailable

_numba_config: Any = numba.config  # its attributes are made at import; the type checker sees none

F = TypeVar("F", bound=Callable[..., Any])

PACKAGE = Path(__file__).parent.parent  # as it was imported: the rooms may stand in it as links
_MESSAGES = PACKAGE / "wire" / "msg"
# `from x.y import (a, b)` and `import x.y`, at any depth of indentation.
_IMPORT = re.compile(r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+([\w., \t]+))", re.MULTILINE)


@cache
def imported_files(file: Path, root: Path) -> frozenset[Path]:
    """The files under `root`, the folder of top-level packages and modules, that a source file itself imports."""
    found: set[Path] = set()
    for origin, names, plain in _IMPORT.findall(file.read_text(encoding="utf-8")):
        wanted = [part.split()[0] for part in plain.split(",") if part.split()]
        if origin:
            wanted = [origin, *(f"{origin}.{name}" for name in re.findall(r"\w+", names))]
        for dotted in wanted:
            parts = dotted.split(".")
            for length in range(1, len(parts) + 1):
                base = root.joinpath(*parts[:length])
                found.update(p for p in (base.with_suffix(".py"), base / "__init__.py") if p.is_file())
    return frozenset(found)


def sources_of(file: Path, root: Path | None = None) -> list[Path]:
    """A source file, all under `root` that it can reach by imports, and the messages: what its kernels can depend on."""
    root = root or PACKAGE.parent
    reached, waiting = {file}, [file]
    while waiting:
        new = imported_files(waiting.pop(), root) - reached
        reached |= new
        waiting.extend(new)
    return [*sorted(reached), *sorted(_MESSAGES.glob("*.msg"))]


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


@cache
def cache_dir(file: Path, root: Path) -> Path:
    """The folder of the compiled kernels that stand in a source file."""
    return cache_root() / f"{file.stem}-{source_hash(sources_of(file, root))}"


def _usable(folder: Path) -> str:
    """A cache folder, made where it is not there yet. Raises Unavailable when this user cannot keep anything in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise Unavailable(
            f"{cache_root()}: compiled kernels cannot be kept there ({error.strerror}); let XDG_CACHE_HOME name a folder of yours"
        ) from None
    return str(folder)


def _home(function: Callable[..., Any]) -> tuple[Path, Path]:
    """The file of the module that calls for `function` to be compiled, and the folder of its top-level package or module."""
    module = sys.modules[sys._getframe(2).f_globals["__name__"]]
    file = Path(module.__file__ or function.__code__.co_filename)
    return file, file.parents[module.__name__.count(".")]


def kernel(*signatures: Any) -> Callable[[F], F]:
    """Compile a pure function for the given explicit signature(s), cached as this module's text says.

    No fastmath, no parallel: equal inputs give equal bytes (within one installation). Division by zero gives inf or nan,
    as in numpy. With `NUMBA_DISABLE_JIT=1` (numba's own switch) the plain function is returned. Raises Unavailable, as its
    module is imported, when the cache folder cannot be written.
    """

    def decorate(function: F) -> F:
        if _numba_config.DISABLE_JIT:
            return function
        before = _numba_config.CACHE_DIR
        _numba_config.CACHE_DIR = _usable(cache_dir(*_home(function)))
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
