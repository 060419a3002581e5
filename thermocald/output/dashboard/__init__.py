"""The live, read-only web page of a daemon, served by a separate process.

It reads the daemon's live folder and store and never connects to the daemon, so that a failure of
the page cannot affect acquisition.
"""

from __future__ import annotations

import logging
import stat
from typing import TYPE_CHECKING

from thermocald.addresses import hide, is_loopback
from thermocald.errors import ConfigurationError, DriverMissing

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

log = logging.getLogger(__name__)

_SHORTEST_TOKEN = 16


def serve(
    store: Path,
    live: Callable[[], Path],
    host: str,
    port: int,
    token_file: Path | None = None,
    names: Sequence[str] = (),
) -> None:
    """Serve the page until stopped.

    live: returns the daemon's live folder; names: further host names under which the page may be
    opened. Raises ConfigurationError, also if the port is in use; DriverMissing without the extra
    `dashboard`.
    """
    token = _read_token(token_file)
    if not is_loopback(host) and token is None:
        raise ConfigurationError(f"host {host} is open to other machines; give --token-file too")
    try:
        from thermocald.output.dashboard.application import build_application
        from thermocald.output.dashboard.server import bind, run_server
    except ImportError as error:
        raise DriverMissing(
            f"the page needs the extra `dashboard`: pip install 'thermocald[dashboard]' ({error})"
        ) from error
    with bind(host, port) as listening:
        application = build_application(store, live, token, host, names)
        log.info("the page is at http://%s:%d/", f"[{host}]" if ":" in host else host, port)
        run_server(application, listening)


def _read_token(path: Path | None) -> str | None:
    if path is None:
        return None
    try:
        mode = path.stat().st_mode
        token = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigurationError(f"{path}: the token cannot be read: {why}") from error
    if mode & (stat.S_IROTH | stat.S_IWOTH):
        raise ConfigurationError(
            f"{path}: everybody may read or change the token; run: chmod o-rw {path}"
        )
    if len(token) < _SHORTEST_TOKEN:
        raise ConfigurationError(
            f"{path}: the token has {len(token)} characters; at least {_SHORTEST_TOKEN} are needed"
        )
    hide(token)
    return token
