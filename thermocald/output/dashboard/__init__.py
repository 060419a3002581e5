"""The web page of a daemon: read-only, live, in a process of its own.

It reads what the daemon leaves (its live folder and its store) and never talks to it: if the page
dies, acquisition does not notice.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from thermocald.errors import ConfigurationError, DriverMissing

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["serve"]

log = logging.getLogger(__name__)

_SHORTEST_TOKEN = 16


def serve(store: Path, live: Path, host: str, port: int, token_file: Path | None = None) -> None:
    """Serve until ended. Raises ConfigurationError, DriverMissing without the extra `dashboard`."""
    token = _read_token(token_file)
    local = host in ("localhost", "::1") or host.startswith("127.")
    if not local and token is None:
        raise ConfigurationError(f"host {host} is open to others; give --token-file too")
    try:
        import uvicorn

        from thermocald.output.dashboard.application import build_application
    except ImportError as error:
        raise DriverMissing(
            f"the page needs the extra `dashboard`: pip install 'thermocald[dashboard]' ({error})"
        ) from error
    application = build_application(store, live, token, host)
    log.warning("the page is at http://%s:%d/", f"[{host}]" if ":" in host else host, port)
    uvicorn.run(
        application,
        host=host,
        port=port,
        log_level="warning",
        access_log=False,
        lifespan="off",
        server_header=False,
        timeout_graceful_shutdown=1,
    )


def _read_token(path: Path | None) -> str | None:
    if path is None:
        return None
    try:
        token = path.read_text(encoding="utf-8").strip()
    except OSError as error:
        raise ConfigurationError(f"{path}: the token cannot be read: {error.strerror}") from error
    if len(token) < _SHORTEST_TOKEN:
        raise ConfigurationError(
            f"{path}: the token has {len(token)} characters; at least {_SHORTEST_TOKEN} are needed"
        )
    return token
