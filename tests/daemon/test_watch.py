"""`trigpointd watch` as a process, beside daemons it finds, waits for, or is refused by."""

import contextlib
import json
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from tests.conftest import Demo
from tests.daemon.test_service import command, run
from tests.daemon.test_tls import certificates as certificates
from tests.daemon.test_tls import docs_config, shell, zenoh_file
from tests.daemon.zenoh_daemon import TIMEOUT_S, Camera, open_session, running
from trigpoint.models.features import FeatureModel
from trigpoint_db.importers.colmap import read_model
from trigpointd.config import ZenohConfig


@contextlib.contextmanager
def watch(*options: object) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        command("trigpointd", "watch", "--json", *options),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        late = threading.Timer(TIMEOUT_S, process.kill)  # whoever waits for a line then fails
        late.start()
        try:
            yield process
        finally:
            late.cancel()
            process.kill()


def time_ns(process: subprocess.Popen[str]) -> int:
    """Return the capture time of the next pose shown."""
    assert process.stdout is not None
    time: int = json.loads(process.stdout.readline())["time_ns"]
    return time


def hear(process: subprocess.Popen[str], text: str) -> None:
    """Wait until this is said."""
    assert process.stderr is not None
    assert any(line == f"trigpointd: {text}\n" for line in process.stderr)


def picture(demo: Demo) -> Path:
    return demo.folder / "survey" / read_model(demo.folder / "sparse")[5].name


def listening(port: int) -> ZenohConfig:
    return ZenohConfig(listen=(f"tcp/127.0.0.1:{port}",), multicast_scouting=False)


def connecting(port: int) -> ZenohConfig:
    return ZenohConfig(connect=(f"tcp/127.0.0.1:{port}",), multicast_scouting=False)


def test_the_last_pose_is_shown_at_once_and_no_other(
    demo: Demo, model: FeatureModel, port: int
) -> None:
    with open_session(mode="router", listen__endpoints=[f"tcp/127.0.0.1:{port}"]) as router:
        poses: list[zenoh.Sample] = []
        router.declare_subscriber("trigpoint/test/pose", poses.append)
        with contextlib.ExitStack() as stack:
            with running(Camera(picture(demo), num_frames=3), demo.map, model, connecting(port)):
                watching = stack.enter_context(
                    watch("--connect", f"tcp/127.0.0.1:{port}", "--exit-with-daemon")
                )
                while time_ns(watching) < 3:  # the last, unless it came while there were others
                    pass
            assert watching.wait(TIMEOUT_S) == 0
            assert watching.stdout is not None
            assert watching.stdout.read() == ""
    assert len(poses) <= 3


def test_each_pose_is_shown_once(demo: Demo, model: FeatureModel, port: int) -> None:
    with running(Camera(picture(demo)), demo.map, model, listening(port)):
        for _ in range(3):
            with watch("--connect", f"tcp/127.0.0.1:{port}") as watching:
                times_ns = [time_ns(watching) for _ in range(10)]
                assert times_ns == sorted(set(times_ns))


def test_who_is_not_there_yet_is_waited_for(demo: Demo, model: FeatureModel, port: int) -> None:
    with watch("--connect", f"tcp/127.0.0.1:{port}") as watching:
        hear(watching, f"nobody answers at tcp/127.0.0.1:{port}; waiting")
        for _ in range(2):
            with running(Camera(picture(demo)), demo.map, model, listening(port)):
                assert time_ns(watching) > 0
                hear(watching, "connected")
            hear(watching, f"nobody answers at tcp/127.0.0.1:{port}; waiting")


def test_where_nobody_publishes_it_says_that_nothing_comes(port: int) -> None:
    with (
        open_session(mode="router", listen__endpoints=[f"tcp/127.0.0.1:{port}"]),
        watch("--key", "trigpoint/dron1/pose", "--connect", f"tcp/127.0.0.1:{port}") as watching,
    ):
        hear(watching, "nothing has come on trigpoint/dron1/pose in 5 s; waiting")


def test_a_file_of_zenohs_settings_leads_to_a_daemon_with_certificates(
    demo: Demo, model: FeatureModel, certificates: Path, port: int
) -> None:
    with watch("--zenoh", zenoh_file("autopilot", certificates, port)) as watching:
        hear(watching, refused_at(port))
        with running(Camera(picture(demo)), demo.map, model, docs_config(certificates, port)):
            times_ns = [time_ns(watching) for _ in range(5)]
            assert times_ns == sorted(set(times_ns))


def refused_at(port: int) -> str:
    at = f"no Zenoh router answers at tls/127.0.0.1:{port}"
    return f"{at}, or our certificates are refused there; waiting"


def test_who_is_in_no_list_of_the_daemon_or_of_another_authority_waits_in_vain(
    demo: Demo, model: FeatureModel, certificates: Path, port: int
) -> None:
    with (
        running(Camera(picture(demo)), demo.map, model, docs_config(certificates, port)),
        watch("--zenoh", zenoh_file("stranger", certificates, port)) as stranger,
        watch("--zenoh", zenoh_file("ground", certificates / "other", port)) as foreigner,
    ):
        hear(stranger, "nothing has come on trigpoint/**/pose in 5 s; waiting")
        hear(foreigner, refused_at(port))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("rm ground.pem", "cannot read {folder}/ground.pem: No such file or directory"),
        ("cp drone1.key ground.key", "KEY_VALUES_MISMATCH"),
        ("echo no > ca.pem", "{folder}/ca.pem is no certificate in PEM"),
        ("cp other/ca.pem ca.pem", "peers that trust {folder}/ca.pem will refuse"),
        (
            "openssl x509 -req -in ground.csr -CA ca.pem -CAkey ca.key -days -1 -out ground.pem",
            "certificate has expired",
        ),
        ("echo '{{' > ground.json5", "{folder}/ground.json5 is no file of Zenoh's settings"),
        ("rm ground.json5", "cannot read {folder}/ground.json5: No such file or directory"),
    ],
)
def test_files_that_cannot_be_used_are_one_line(
    certificates: Path, tmp_path: Path, port: int, change: str, message: str
) -> None:
    folder = shutil.copytree(certificates, tmp_path / "certificates")
    file = zenoh_file("ground", folder, port)
    shell(folder, change.replace("{{", "{"))
    done = run("trigpointd", "watch", "--zenoh", file)
    assert (done.returncode, done.stdout) == (1, "")
    assert message.format(folder=folder) in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--key", "trigpoint//pose"), "'trigpoint//pose' is no key expression"),
        (("--connect", "nonsense"), "zenoh.connect: nonsense cannot be read; write an endpoint"),
        (("--listen", "tcp/192.0.2.1:1"), "cannot open a Zenoh session on tcp/192.0.2.1:1"),
    ],
)
def test_options_that_cannot_be_used_are_one_line(options: tuple[str, ...], message: str) -> None:
    done = run("trigpointd", "watch", *options)
    assert (done.returncode, done.stdout) == (1, "")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
