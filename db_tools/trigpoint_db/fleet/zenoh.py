"""Maps over Zenoh: `<key>/manifest` and `<key>/chunk/<sha256>`, which anybody may ask for."""

from __future__ import annotations

import contextlib
import json
import threading
from pathlib import Path
from typing import Self

import zenoh

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint_db.fleet.manifest import Manifest
from trigpoint_db.fleet.offer import Offer

_REPLY_TIMEOUT_S = 60.0  # the chunks in work on a link of 1 Mbit/s
_REFUSAL = b"not in this generation"


def open_session(
    settings: Path | None, connect: list[str] | None, listen: list[str] | None
) -> zenoh.Session:
    """Join the network with Zenoh's settings from a file; endpoints take the place of its own."""
    try:
        config = zenoh.Config() if settings is None else zenoh.Config.from_file(settings)
        if settings is None and (connect or listen):
            config.insert_json5("scouting/multicast/enabled", "false")
        for what, endpoints in (("connect", connect), ("listen", listen)):
            if endpoints:
                config.insert_json5(f"{what}/endpoints", json.dumps(endpoints))
        if listen:
            config.insert_json5("listen/exit_on_failure", "true")
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join(
            [*([str(settings)] if settings else []), *(connect or []), *(listen or [])]
        )
        reason = " ".join(str(error).split(" at ")[0].split())
        raise ConfigError(
            f"cannot open a Zenoh session with {where or 'its default settings'}: {reason}; write "
            "an endpoint as tcp/10.0.0.5:7447"
        ) from error


def check_key(key: str) -> None:
    """Refuse a key that Zenoh cannot have, or that stands for several."""
    try:
        zenoh.KeyExpr(key)
    except zenoh.ZError as error:
        raise ConfigError(f"{key!r} is no key; write it as trigpoint/maps/office") from error
    if "*" in key:
        raise ConfigError(f"{key!r} stands for several keys; name one")


class Publisher:
    """Serves a map, always as its last whole commit, until it is closed."""

    def __init__(self, session: zenoh.Session, key: str, path: Path) -> None:
        self._session = session
        self._key = key
        self._folder = path.parent
        self._reader = MapReader.open(path)
        self._offer = Offer(self._reader, self._folder)
        self._lock = threading.Lock()
        session.declare_queryable(f"{key}/manifest", self._reply_manifest, complete=True)
        session.declare_queryable(f"{key}/chunk/*", self._reply_chunk, complete=True)
        self._announce()

    @property
    def manifest(self) -> Manifest:
        """Of what is published now."""
        return self._offer.manifest

    def refresh(self) -> bool:
        """Publish the map's newest commit; True if that is another one.

        Where the map cannot be used, the error is raised, and what was published stays.
        """
        is_tried = self._reader.generation == self._offer.manifest.generation
        if not self._reader.refresh() and is_tried:
            return False
        new = Offer(self._reader, self._folder)
        with self._lock:
            old, self._offer = self._offer, new
            old.close()
        self._announce()
        return True

    def close(self) -> None:
        """Leave the network."""
        self._session.close()  # type: ignore[no-untyped-call]
        self._offer.close()
        self._reader.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _announce(self) -> None:
        self._session.put(f"{self._key}/manifest", self._encode_manifest())

    def _encode_manifest(self) -> bytes:
        return self._offer.manifest.model_dump_json().encode()

    def _reply_manifest(self, query: zenoh.Query) -> None:
        _reply(query, f"{self._key}/manifest", self._encode_manifest())

    def _reply_chunk(self, query: zenoh.Query) -> None:
        key = str(query.key_expr)
        with self._lock:  # so that no offer is closed that is being read
            data = self._offer.read(key.rpartition("/")[2])
        _reply(query, key, data)


def _reply(query: zenoh.Query, key: str, payload: bytes | None) -> None:
    with query, contextlib.suppress(zenoh.ZError):  # who asked has left
        if payload is None:
            query.reply_err(_REFUSAL, encoding=zenoh.Encoding.TEXT_PLAIN)
        else:
            query.reply(key, payload)


class RemoteMap:
    """A published map, as a `fetch.Remote`."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._session = session
        self.key = key
        self._news = threading.Event()
        self._cancelled = zenoh.CancellationToken()
        session.declare_subscriber(f"{key}/manifest", lambda _: self._news.set())

    def get_manifest(self, timeout_s: float) -> Manifest | None:
        """Ask for the manifest; None where nobody answers."""
        self._news.clear()
        self._cancelled = zenoh.CancellationToken()
        for payload in self._get("manifest", min(timeout_s, _REPLY_TIMEOUT_S)):
            if payload is not None:
                return Manifest.decode(payload)
        return None

    def get_chunk(self, sha256: str) -> list[bytes | None]:
        """Ask for a chunk; a publisher that does not have it answers None."""
        return self._get(f"chunk/{sha256}", _REPLY_TIMEOUT_S)

    def cancel(self) -> None:
        """Wait for no chunk any more, until the manifest is asked for again."""
        self._cancelled.cancel()  # type: ignore[no-untyped-call]

    def wait_for_news(self, timeout_s: float) -> None:
        """Wait until a manifest is announced."""
        self._news.wait(timeout_s)

    def _get(self, what: str, timeout_s: float) -> list[bytes | None]:
        replies = self._session.get(
            f"{self.key}/{what}", timeout=timeout_s, cancellation_token=self._cancelled
        )
        answers = list[bytes | None]()
        for reply in replies:
            if reply.ok is not None:
                answers.append(reply.ok.payload.to_bytes())
            elif reply.err is not None and reply.err.payload.to_bytes() == _REFUSAL:
                answers.append(None)  # any other error is Zenoh's: nobody has answered in time
        return answers
