"""Matrix products on one thread each, where several run at a time."""

from __future__ import annotations

from functools import cache
from typing import Any


@cache
def _libraries() -> Any:
    # Finding them takes as long as a small image; NumPy's is loaded by now.
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def one_thread() -> Any:
    """Return a context in which matrix products take one thread."""
    return _libraries().limit(limits=1, user_api="blas")
