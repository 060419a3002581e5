"""A server on loopback; unplugging stops it."""

from tests.drivers.fakes.alert_servers import MailServer
from tests.drivers.laboratory.bench import on_loopback

output = on_loopback(
    MailServer,
    {"host": "127.0.0.1", "security": "none", "sender": "a@example.org",
     "recipients": ["b@example.org"], "when": [{"no_result": 2}], "timeout_s": 2.0},
)  # fmt: skip
