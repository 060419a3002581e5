"""A self-signed certificate for 127.0.0.1."""

from __future__ import annotations

import shutil
import ssl
import subprocess

import pytest


def own_context(folder):
    """Return (certificate, a server's TLS context with it); skips if openssl is not installed."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl: apt-get install openssl")
    certificate, key = folder / "own.pem", folder / "own.key"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
         "-nodes", "-days", "2", "-subj", "/CN=loopback", "-addext",
         "subjectAltName=IP:127.0.0.1", "-addext", "keyUsage=critical,digitalSignature,keyCertSign",
         "-out", certificate, "-keyout", key],
        check=True, capture_output=True,
    )  # fmt: skip
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    return certificate, context
