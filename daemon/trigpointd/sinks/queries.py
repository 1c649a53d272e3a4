"""Zenoh's queries as requests."""

from __future__ import annotations

import logging
from functools import partial

import zenoh

from trigpoint.errors import RequestError
from trigpointd.request_queue import RequestQueue
from trigpointd.requests import Answer, Request

KINDS = ("localize", "map", "config")

_log = logging.getLogger(__name__)


def declare_queryables(session: zenoh.Session, base_key: str, requests: RequestQueue) -> None:
    """Answer queries on `<base>/localize`, `<base>/map` and `<base>/config`."""
    for kind in KINDS:
        key = f"{base_key}/{kind}"
        session.declare_queryable(key, partial(_receive, requests, key, kind))


def _receive(requests: RequestQueue, key: str, kind: str, query: zenoh.Query) -> None:
    reply = partial(_reply, key, query)
    try:
        requests.put(_parse(kind, query), reply)
    except RequestError as error:
        reply(Answer(str(error).encode(), is_error=True))


def _parse(kind: str, query: zenoh.Query) -> Request:
    parameters = dict(query.parameters)  # type: ignore[call-overload]
    encoding = "" if query.encoding is None else str(query.encoding)
    payload = b"" if query.payload is None else query.payload.to_bytes()
    return Request(kind, parameters, encoding, payload)


def _reply(key: str, query: zenoh.Query, answer: Answer) -> None:
    with query:  # its end tells the peer that there is no more to come
        try:
            if answer.is_error:
                query.reply_err(answer.payload, encoding=zenoh.Encoding.TEXT_PLAIN)
            else:
                query.reply(key, answer.payload, encoding=zenoh.Encoding.APPLICATION_JSON)
        except zenoh.ZError as error:  # the peer has left
            _log.debug("cannot answer on %s: %s", key, error)
