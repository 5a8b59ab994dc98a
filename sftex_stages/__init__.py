"""sftex: shape, and light, from the texture in one photograph (Lobay & Forsyth, IJCV 67(1), 2006)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .results.archive import Result as Result
    from .results.archive import open_result as open_result

__version__ = "0.1.0"
__all__ = ["Result", "__version__", "open_result"]


def __getattr__(name: str) -> Any:
    """Import the archive's reader on first use: ``import sftex_stages`` alone stays instant."""
    if name in ("Result", "open_result"):
        from .results import archive

        return getattr(archive, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
