"""Zenoh's settings for encryption and access control, and a check of the certificates."""

from __future__ import annotations

import contextlib
import ssl
from pathlib import Path
from typing import Any

from trigpoint.errors import ConfigError
from trigpointd.config import TlsConfig

# What readers and operators may do, and operators only. What is not named is denied.
_PUBLISHED = {
    "id": "published",
    "permission": "allow",
    "flows": ["egress"],
    "messages": ["put", "reply", "liveliness_token", "declare_queryable"],
    "key_exprs": ["**"],
}
_SUBSCRIBE = {
    "id": "subscribe",
    "permission": "allow",
    "flows": ["ingress"],
    "messages": ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"],
    "key_exprs": ["**"],
}
_GET_LAST = {
    "id": "get_last",
    "permission": "allow",
    "flows": ["ingress"],
    "messages": ["query"],
    "key_exprs": ["**/pose", "**/status"],
}
_REQUEST = {**_GET_LAST, "id": "request", "key_exprs": ["**"]}


def make_tls_settings(config: TlsConfig) -> dict[str, Any]:
    """Return Zenoh's settings by their paths; a file that cannot be used is an error."""
    check_certificates(config.ca, config.certificate, config.private_key)
    own = {"certificate": str(config.certificate), "private_key": str(config.private_key)}
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": str(config.ca),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            **{
                f"{role}_{what}": path
                for role in ("listen", "connect")
                for what, path in own.items()
            },
        },
        "access_control": _access_control(config),
    }


def _access_control(config: TlsConfig) -> dict[str, Any]:
    reading = [_PUBLISHED, _SUBSCRIBE, _GET_LAST]
    roles = {
        "readers": (config.readers, reading),
        "operators": (config.operators, [*reading, _REQUEST]),
    }
    taken = {role: given for role, given in roles.items() if given[0]}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [*reading, _REQUEST],
        "subjects": [
            {"id": role, "cert_common_names": list(names)} for role, (names, _) in taken.items()
        ],
        "policies": [
            {"subjects": [role], "rules": [rule["id"] for rule in rules]}
            for role, (_, rules) in taken.items()
        ],
    }


def check_certificates(
    ca: Path, certificate: Path, private_key: Path, setting: str = "zenoh.tls"
) -> None:
    """Shake hands with ourselves: Zenoh takes an expired or foreign certificate without a word.

    `setting` is where the files are named.
    """
    for path in (ca, certificate, private_key):
        try:
            path.read_bytes()
        except OSError as error:
            raise ConfigError(f"{setting}: cannot read {path}: {error.strerror}") from error
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname = False  # peers ask for the name that they connect to
    try:
        client.load_verify_locations(ca)
    except ssl.SSLError as error:
        raise ConfigError(f"{setting}: {ca} is no certificate in PEM") from error
    try:
        server.load_cert_chain(certificate, private_key)
    except ssl.SSLError as error:
        raise ConfigError(
            f"{setting}: {certificate} and {private_key} are no certificate and its "
            f"private key in PEM: {error.reason or error}"
        ) from error
    try:
        _shake_hands(server, client)
    except ssl.SSLCertVerificationError as error:
        raise ConfigError(
            f"{setting}: peers that trust {ca} will refuse {certificate}: "
            f"{error.verify_message}; make a new certificate (docs/security.md)"
        ) from error


def _shake_hands(server_context: ssl.SSLContext, client_context: ssl.SSLContext) -> None:
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    server = server_context.wrap_bio(to_server, to_client, server_side=True)
    client = client_context.wrap_bio(to_client, to_server)
    for side in (client, server, client):  # hello, certificate, verdict
        with contextlib.suppress(ssl.SSLWantReadError):
            side.do_handshake()
