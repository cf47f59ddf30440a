"""One BLAS thread for many small matrices; the libraries are searched for once, which takes milliseconds."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()


def one_thread() -> AbstractContextManager[object]:
    """A context in which the BLAS and OpenMP libraries loaded at the first call use one thread."""
    return _libraries().limit(limits=1)
