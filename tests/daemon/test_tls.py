"""Who may do what, by certificates made as docs/security.md says; real sessions on loopback."""

import json
import shutil
import subprocess
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.conftest import Demo
from tests.daemon.test_service import run
from tests.daemon.zenoh_daemon import Camera, get, open_session, running, wait_until
from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint.models.features import FeatureModel
from trigpoint_db.fleet.zenoh import Publisher
from trigpoint_db.fleet.zenoh import open_session as open_fleet
from trigpoint_db.importers.colmap import read_model
from trigpointd.config import ZenohConfig, load_config
from trigpointd.session import make_settings
from trigpointd.sinks.zenoh import ZenohSink

DOC = Path(__file__).parents[2] / "docs" / "security.md"


def block(language: str, which: int = 1) -> str:
    if not DOC.is_file():
        pytest.skip("needs the checkout's docs/")
    return DOC.read_text().split(f"```{language}\n")[which].split("```")[0]


def shell(folder: Path, script: str) -> None:
    subprocess.run(["sh", "-ec", script], cwd=folder, check=True, capture_output=True)


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the docs' commands make, a certificate that nobody lists, and another authority's."""
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")
    folder = tmp_path_factory.mktemp("certificates")
    script = block("sh").replace("in drone1 ", "in drone1 stranger ")
    shell(folder, script)
    (folder / "other").mkdir()
    shell(folder / "other", script)
    return folder


def docs_config(certificates: Path, port: int, **tls: Any) -> ZenohConfig:
    """The docs' settings, beside the certificates, on a port of loopback."""
    text = block("toml").replace("0.0.0.0:7447", f"127.0.0.1:{port}")
    tables = tomllib.loads(text)["zenoh"]
    files = {key: certificates / tables["tls"][key] for key in ("ca", "certificate", "private_key")}
    return ZenohConfig.model_validate({**tables, "tls": {**tables["tls"], **files, **tls}})


def zenoh_file(name: str, certificates: Path, port: int, which: int = 1) -> Path:
    """Write the docs' settings for a program, beside the certificates."""
    text = block("json5", which)
    for address in ("drone1", "0.0.0.0"):
        text = text.replace(f"tls/{address}:7447", f"tls/127.0.0.1:{port}")
    text = text.replace("ground", name)
    for file in ("ca.pem", f"{name}.pem", f"{name}.key"):
        text = text.replace(f'"{file}"', f'"{certificates / file}"')
    path = certificates / f"{name}.json5"
    path.write_text(text)
    return path


def connect_as(name: str, certificates: Path, port: int) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_file(zenoh_file(name, certificates, port)))


def see(session: zenoh.Session) -> tuple[list[str], Callable[[], dict[str, list[str]]]]:
    """Subscribe to everything; the function asks everything that there is to ask."""
    seen: list[str] = []
    session.declare_subscriber("trigpoint/**", lambda sample: seen.append(str(sample.key_expr)))
    session.liveliness().declare_subscriber(
        "trigpoint/**", lambda sample: seen.append(str(sample.key_expr)), history=True
    )

    def ask() -> dict[str, list[str]]:
        selectors = ("pose", "status", "config", "map", "map?action=remove;name=none", "localize")
        return {
            selector: [
                "answer" if reply.ok is not None else reply.err.payload.to_string()  # type: ignore[union-attr]
                for reply in session.get(f"trigpoint/test/{selector}", timeout=2.0)
            ]
            for selector in selectors
        }

    return seen, ask


def test_each_may_do_what_its_name_is_listed_for(
    demo: Demo, model: FeatureModel, certificates: Path, port: int
) -> None:
    picture = demo.folder / "survey" / read_model(demo.folder / "sparse")[5].name
    config = docs_config(certificates, port)
    with (
        running(Camera(picture), demo.map, model, config),
        connect_as("ground", certificates, port) as ground,
        connect_as("autopilot", certificates, port) as autopilot,
        connect_as("stranger", certificates, port) as stranger,
    ):
        seen = {}
        asked = {}
        for name, session in (("stranger", stranger), ("autopilot", autopilot), ("ground", ground)):
            seen[name], asked[name] = see(session)
        published = {"trigpoint/test/alive", "trigpoint/test/pose", "trigpoint/test/status"}
        for name in ("ground", "autopilot"):
            wait_until(lambda name=name: set(seen[name]) >= published)  # type: ignore[misc]
        answers = {name: ask() for name, ask in asked.items()}
        wait_until(lambda: seen["ground"].count("trigpoint/test/pose") >= 5)
    assert seen["stranger"] == []
    assert not any(answers["stranger"].values())
    assert answers["autopilot"]["pose"] == answers["autopilot"]["status"] == ["answer"]
    assert not any(answers["autopilot"][key] for key in ("config", "map", "localize"))
    for key in ("pose", "status", "config", "map"):
        assert answers["ground"][key] == ["answer"]
    (said,) = answers["ground"]["map?action=remove;name=none"]
    assert "holds no image 'none'" in said
    assert answers["ground"]["localize"] == ["parameter 'camera' is missing"]


def test_who_has_no_certificate_of_the_authority_does_not_connect(
    demo: Demo, model: FeatureModel, certificates: Path, port: int
) -> None:
    picture = demo.folder / "survey" / read_model(demo.folder / "sparse")[5].name
    with running(Camera(picture), demo.map, model, docs_config(certificates, port)):
        with connect_as("ground", certificates, port):
            pass
        with pytest.raises(zenoh.ZError):
            connect_as("ground", certificates / "other", port)
        trusting = {"root_ca_certificate": str(certificates / "ca.pem")}
        for endpoint in ("tls", "tcp"):
            with pytest.raises(zenoh.ZError):
                open_session(
                    mode="client",
                    connect__endpoints=[f"{endpoint}/127.0.0.1:{port}"],
                    transport__link__tls=trusting,
                )


def test_a_daemon_behind_a_router_takes_it_for_an_operator(
    demo: Demo, model: FeatureModel, certificates: Path, port: int
) -> None:
    picture = demo.folder / "survey" / read_model(demo.folder / "sparse")[5].name
    listening = docs_config(certificates, port)
    as_client = listening.model_copy(
        update={"mode": "client", "listen": (), "connect": (f"tls/127.0.0.1:{port}",)}
    )
    tls = {
        "root_ca_certificate": str(certificates / "ca.pem"),
        "enable_mtls": True,
        "listen_certificate": str(certificates / "ground.pem"),
        "listen_private_key": str(certificates / "ground.key"),
    }
    with (
        open_session(
            mode="router",
            listen__endpoints=[f"tls/127.0.0.1:{port}"],
            transport__link__tls=tls,
        ) as router,
        running(Camera(picture), demo.map, model, as_client),
    ):
        seen, _ = see(router)
        wait_until(lambda: seen.count("trigpoint/test/pose") >= 2)
        ((is_good, text),) = get(router, "trigpoint/test/map")
        assert is_good, text


def test_a_map_is_fetched_by_who_has_a_certificate(
    demo: Demo, certificates: Path, tmp_path: Path, port: int
) -> None:
    key, out = "trigpoint/maps/room", tmp_path / "room.tpmap"
    fetch = ("trigpoint_db", "fetch", key, "-o", out, "--timeout", "5", "--zenoh")
    listening = open_fleet(zenoh_file("ground", certificates, port, which=2), None, None)
    with Publisher(listening, key, demo.map):
        stranger = run(*fetch, zenoh_file("drone1", certificates / "other", port))
        assert stranger.returncode == 1
        assert stranger.stderr.startswith("trigpoint-db: cannot open a Zenoh session with ")
        assert stranger.stderr.count("\n") == 1
        assert not out.exists()
        done = run(*fetch, zenoh_file("drone1", certificates, port))
        assert done.returncode == 0, done.stderr
    with MapReader.open(demo.map) as ours, MapReader.open(out) as theirs:
        assert theirs.verify() == []
        assert theirs.names() == ours.names()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("rm drone1.pem", r"cannot read .*drone1\.pem: No such file"),
        ("rm ca.pem", r"cannot read .*ca\.pem: No such file"),
        ("echo no > ca.pem", r"ca\.pem is no certificate in PEM"),
        ("echo no > drone1.pem", r"drone1\.pem and .* are no certificate and its private key"),
        ("cp ground.key drone1.key", "KEY_VALUES_MISMATCH"),
        ("cp other/ca.pem ca.pem", "will refuse .*drone1.pem: .*; make a new certificate"),
        (
            "openssl x509 -req -in drone1.csr -CA ca.pem -CAkey ca.key -days -1 -out drone1.pem",
            "certificate has expired",
        ),
    ],
)
def test_a_file_that_cannot_be_used_is_one_line_at_the_start(
    certificates: Path, tmp_path: Path, port: int, change: str, message: str
) -> None:
    folder = shutil.copytree(certificates, tmp_path / "certificates")
    shell(folder, change)
    with pytest.raises(ConfigError, match=message) as caught:
        ZenohSink(docs_config(folder, port), "trigpoint/test")
    assert "\n" not in str(caught.value)


def test_check_config_says_in_one_line_which_certificate_cannot_be_used(
    demo: Demo, certificates: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(certificates, tmp_path / "certificates")
    config = folder / "trigpointd.toml"
    source = f'map = "{demo.map}"\nsource = {{ type = "mcap", path = "{demo.recording}" }}\n'
    config.write_text(source + block("toml"))
    assert run("trigpointd", "check-config", config).returncode == 0
    for change, message in (
        ("cp other/drone1.pem other/drone1.key .", f"refuse {folder}/drone1.pem: "),
        ("cp ground.key drone1.key", "KEY_VALUES_MISMATCH"),
        ("rm drone1.key", f"cannot read {folder}/drone1.key"),
    ):
        shell(folder, change)
        done = run("trigpointd", "check-config", config)
        assert (done.returncode, done.stdout) == (1, "")
        assert message in done.stderr
        assert done.stderr.count("\n") == 1


def test_an_endpoint_that_is_not_encrypted_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "trigpointd.toml"
    text = block("toml").replace("tls/0.0.0.0", "tcp/0.0.0.0")
    path.write_text(f'map = "m"\nsource = {{ type = "mcap", path = "f" }}\n{text}')
    with pytest.raises(ConfigError, match=r"'tcp/0.0.0.0:7447' must begin with tls/"):
        load_config(path)


def test_without_an_endpoint_no_port_is_opened(certificates: Path, port: int) -> None:
    config = docs_config(certificates, port).model_copy(update={"listen": ()})
    settings = make_settings(config)
    assert json.loads(settings.get_json("listen/endpoints")) == []
    assert json.loads(settings.get_json("transport/link/protocols")) == ["tls"]
