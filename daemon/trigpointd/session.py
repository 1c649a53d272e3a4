"""A Zenoh session that stays: opened again, in a thread of its own, whenever it is lost."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path

import zenoh

from trigpoint.errors import ConfigError
from trigpointd.backoff import Backoff
from trigpointd.config import ZenohConfig
from trigpointd.sinks.tls import check_certificates, make_tls_settings

_MIN_MESSAGE_BYTES = 2**20
_LOOK_S = 1.0  # how often it is looked whether somebody is there
_MAX_DELAY_S = 4.0  # between attempts, as Zenoh's own
_JOIN_S = 1.0  # an attempt in progress may take longer than the daemon's end


def make_settings(config: ZenohConfig) -> zenoh.Config:
    """Put the settings in Zenoh's form; an endpoint it cannot read is an error."""
    settings = zenoh.Config()
    settings.insert_json5("mode", json.dumps(config.mode))
    settings.insert_json5("scouting/multicast/enabled", json.dumps(config.multicast_scouting))
    for what, endpoints in (("listen", config.listen), ("connect", config.connect)):
        set_endpoints(settings, what, endpoints)
    # Larger messages are dropped on arrival; up to this, the sender of a request is told.
    max_bytes = max(4 * config.requests.max_payload_bytes, _MIN_MESSAGE_BYTES)
    settings.insert_json5("transport/link/rx/max_message_size", json.dumps(max_bytes))
    if config.tls is not None:
        if not config.listen:  # instead of Zenoh's default, a plain port
            settings.insert_json5("listen/endpoints", "[]")
        for path, value in make_tls_settings(config.tls).items():
            settings.insert_json5(path, json.dumps(value))
    return settings


def load_settings(path: Path) -> zenoh.Config:
    """Read a file of Zenoh's settings; certificates that cannot be used are an error."""
    try:
        path.read_bytes()
        settings = zenoh.Config.from_file(path)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except zenoh.ZError as error:
        raise ConfigError(f"{path} is no file of Zenoh's settings: {one_line(error)}") from error
    tls = json.loads(settings.get_json("transport/link/tls"))
    names = ("root_ca_certificate", "connect_certificate", "connect_private_key")
    ca, certificate, private_key = (tls[name] for name in names)
    if ca and certificate and private_key:
        check_certificates(Path(ca), Path(certificate), Path(private_key), setting=str(path))
    return settings


def set_endpoints(settings: zenoh.Config, what: str, endpoints: tuple[str, ...]) -> None:
    """Set where to `listen` or `connect`; without endpoints, leave what there is."""
    if not endpoints:  # an empty list would replace Zenoh's own default
        return
    try:
        settings.insert_json5(f"{what}/endpoints", json.dumps(endpoints))
    except zenoh.ZError as error:
        raise ConfigError(
            f"zenoh.{what}: {', '.join(endpoints)} cannot be read; write an endpoint as "
            "tcp/127.0.0.1:7447"
        ) from error
    if what == "listen":
        settings.insert_json5("listen/exit_on_failure", "true")


class Link:
    """Keeps a session open.

    To a router or a peer that comes back Zenoh connects by itself. A client's first connection,
    and a session that was closed, are made here, after growing delays.

    Parameters
    ----------
    settings : zenoh.Config
    declare : callable
        Declares on a new session what there is to declare.
    changed : callable
        Told of each change of `problem`.

    An endpoint that cannot be listened on is an error at the start, a router that is not there is
    none.
    """

    def __init__(
        self,
        settings: zenoh.Config,
        declare: Callable[[zenoh.Session], None],
        changed: Callable[[str], None],
    ) -> None:
        self._settings = settings
        self._declare = declare
        self._changed = changed
        self._problem = ""
        self._lock = threading.Lock()  # a session is opened, or it is the end
        self._ending = threading.Event()
        self._session: zenoh.Session | None = None
        self._is_client = json.loads(settings.get_json("mode")) == "client"
        self._endpoints = [*_endpoints(settings, "listen"), *_endpoints(settings, "connect")]
        self._nobody = _describe_absence(self._is_client, _endpoints(settings, "connect"))
        try:
            self._open()
        except ConfigError:
            if not self._is_client:
                raise
            self._report(self._nobody)
        self._thread = threading.Thread(target=self._keep, name="zenoh", daemon=True)
        self._thread.start()

    @property
    def problem(self) -> str:
        """Why nobody is reached, in a line; empty while all is well."""
        return self._problem

    def close(self) -> None:
        """Leave the network."""
        self._ending.set()
        with self._lock:
            if self._session is not None:
                self._session.close()  # type: ignore[no-untyped-call]
        self._thread.join(_JOIN_S)

    def _open(self) -> None:
        try:
            session = zenoh.open(self._settings)
        except zenoh.ZError as error:
            raise ConfigError(
                f"cannot open a Zenoh session on {', '.join(self._endpoints) or 'any endpoint'}: "
                f"{one_line(error)}; is the port in use by another program, or the address "
                "mistyped?"
            ) from error
        with self._lock:
            self._session = session
            if self._ending.is_set():
                session.close()  # type: ignore[no-untyped-call]
            else:
                self._declare(session)

    def _keep(self) -> None:
        backoff = Backoff(_LOOK_S, _MAX_DELAY_S)
        delay_s = backoff.next_s() if self._session is None else _LOOK_S
        while not self._ending.wait(delay_s):
            try:
                if self._session is None or self._session.is_closed():
                    self._report(self._problem or "the Zenoh session was closed")
                    self._open()
                problem, delay_s = self._look(), _LOOK_S
                backoff.reset()
            except (ConfigError, zenoh.ZError) as error:
                problem = self._nobody if self._is_client else one_line(error)
                delay_s = backoff.next_s()
            self._report(problem)

    def _look(self) -> str:
        assert self._session is not None
        info = self._session.info
        return "" if info.routers_zid() or info.peers_zid() else self._nobody

    def _report(self, problem: str) -> None:
        if problem != self._problem and not self._ending.is_set():
            self._problem = problem
            self._changed(problem)


def one_line(error: Exception) -> str:
    """Leave out where in Zenoh's source an error comes from."""
    return " ".join(str(error).split(" at ")[0].split())


def _endpoints(settings: zenoh.Config, what: str) -> list[str]:
    endpoints = json.loads(settings.get_json(f"{what}/endpoints"))
    if isinstance(endpoints, dict):  # by mode
        endpoints = endpoints.get(json.loads(settings.get_json("mode")), [])
    return list(endpoints)


def _describe_absence(is_client: bool, endpoints: list[str]) -> str:
    """Say what is wrong while nobody is connected; for a peer without a goal nothing is."""
    if not (is_client or endpoints):
        return ""
    who = "no Zenoh router" if is_client else "nobody"
    said = f"{who} answers at {', '.join(endpoints) or 'any address'}"
    encrypted = any(endpoint.startswith(("tls/", "quic/")) for endpoint in endpoints)
    return f"{said}, or our certificates are refused there" if encrypted else said
