"""Poses and answers over real Zenoh sessions on loopback."""

import json
import subprocess
import sys
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import zenoh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from tests.conftest import Demo
from tests.daemon.zenoh_daemon import (
    TIMEOUT_S,
    Camera,
    connect,
    get,
    open_session,
    running,
    wait_until,
)
from trigpoint.models.features import FeatureModel
from trigpoint_db.build import build_map
from trigpoint_db.demo import CAMERA
from trigpoint_db.importers.colmap import read_model
from trigpointd.config import RequestsConfig, ZenohConfig

POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
DOCS = Path(__file__).parents[2] / "docs"


def peer(port: int, **limits: Any) -> ZenohConfig:
    requests = RequestsConfig.model_validate({"cameras": {"phone": CAMERA.to_text()}, **limits})
    return ZenohConfig(
        listen=(f"tcp/127.0.0.1:{port}",), multicast_scouting=False, requests=requests
    )


def picture(demo: Demo) -> Path:
    return demo.folder / "survey" / read_model(demo.folder / "sparse")[5].name


def decode_pose(payload: bytes) -> Any:
    return get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(payload, POSE_TYPE)


class Inbox:
    """Counts what arrives, by the last part of the key."""

    def __init__(self, session: zenoh.Session) -> None:
        self.counts = Counter[str]()
        session.declare_subscriber("trigpoint/test/*", self._collect)

    def _collect(self, sample: zenoh.Sample) -> None:
        self.counts[str(sample.key_expr).rsplit("/", 1)[1]] += 1

    def wait_for_more(self, num_poses: int) -> None:
        enough = self.counts["pose"] + num_poses
        wait_until(lambda: self.counts["pose"] >= enough)


def test_who_joins_late_gets_the_last_pose_and_status(
    demo: Demo, model: FeatureModel, port: int
) -> None:
    with (
        running(Camera(picture(demo), num_frames=3), demo.map, model, peer(port)),
        connect(port) as session,
    ):
        inbox = Inbox(session)

        def last(key: str) -> list[bytes]:
            replies = session.get(f"trigpoint/test/{key}", timeout=TIMEOUT_S)
            return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

        wait_until(lambda: [json.loads(text)["time_ns"] for text in last("status")] == [3])
        (pose,) = last("pose")
        assert decode_pose(pose).header.stamp.nanosec == 3
        before = inbox.counts["pose"]  # what a plain subscriber has got after that: nothing
        assert before <= 3


@pytest.mark.skipif(not DOCS.is_dir(), reason="needs the checkout's docs/")
def test_every_message_of_the_docs_table_is_decoded_by_others(
    demo: Demo, model: FeatureModel, port: int
) -> None:
    table = (
        (DOCS / "interfaces.md").read_text().split("|---|---|---|---|---|\n")[1].split("\n\n")[0]
    )
    rows = [[cell.strip(" `") for cell in row.split("|")[1:-1]] for row in table.splitlines()]
    encodings = {key.removeprefix("<base>/"): encoding for key, _, _, encoding, _ in rows}
    assert set(encodings) == {"pose", "status", "localize", "map", "config", "alive"}
    image = picture(demo).read_bytes()
    samples: dict[str, zenoh.Sample] = {}
    with (
        running(Camera(picture(demo)), demo.map, model, peer(port)),
        connect(port) as session,
    ):
        Inbox(session).wait_for_more(1)
        for key in ("pose", "status", "localize?camera=phone", "map", "config"):
            (reply,) = session.get(
                f"trigpoint/test/{key}", payload=image, encoding="image/jpeg", timeout=TIMEOUT_S
            )
            assert reply.ok is not None
            samples[key.split("?")[0]] = reply.ok
        (alive,) = session.liveliness().get("trigpoint/test/alive", timeout=TIMEOUT_S)
        assert alive.ok is not None
    for key, sample in samples.items():
        assert str(sample.key_expr) == f"trigpoint/test/{key}"
        assert str(sample.encoding) == encodings[key]
    pose = decode_pose(samples["pose"].payload.to_bytes())
    decoded = {key: json.loads(samples[key].payload.to_bytes()) for key in samples if key != "pose"}
    assert pose.header.frame_id == decoded["config"]["map_frame"]
    assert decoded["status"]["status"] == decoded["localize"]["status"] == "LOCALIZED"
    assert decoded["map"]["num_images"] == 140


@pytest.mark.skipif(not DOCS.is_dir(), reason="needs the checkout's docs/")
@pytest.mark.parametrize(
    ("section", "expected"),
    [("## Pose", "geometry_msgs__msg__Point"), ("## Requests", "LOCALIZED")],
)
def test_the_examples_of_the_docs_run_as_they_stand(
    demo: Demo, model: FeatureModel, port: int, section: str, expected: str
) -> None:
    text = (DOCS / "interfaces.md").read_text().split(section)[1]
    example = text.split("```python\n")[1].split("```")[0]
    assert example.count("\n") <= 15
    settings = {
        "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"]},
        "scouting": {"multicast": {"enabled": False}},
    }
    here = example.replace("zenoh.Config()", f"zenoh.Config.from_json5('{json.dumps(settings)}')")
    with (
        running(Camera(picture(demo)), demo.map, model, peer(port)),
        connect(port) as session,
    ):
        Inbox(session).wait_for_more(1)
        done = subprocess.run(
            [sys.executable, "-c", here, str(picture(demo))],
            input="\n", capture_output=True, text=True, timeout=TIMEOUT_S, check=False,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert expected in done.stdout


def test_the_map_is_changed_from_outside_and_used_at_once(
    demo: Demo, model: FeatureModel, port: int, tmp_path: Path
) -> None:
    survey = read_model(demo.folder / "sparse")
    path = tmp_path / "m.tpmap"
    build_map(path, [], demo.folder / "survey", model)
    allowed = peer(port, allow=("localize", "map", "change_map"), max_rate_hz=1000.0)
    with running(Camera(picture(demo)), path, model, allowed), connect(port) as session:
        inbox, text = Inbox(session), ""
        for image in survey[:12]:
            pose = (*image.cam_from_world.quaternion, *image.cam_from_world.t)
            selector = zenoh.Selector(
                "trigpoint/test/map",
                {"action": "add", "name": image.name, "camera": "phone",
                 "cam_from_world": " ".join(map(str, pose))},
            )  # fmt: skip
            payload = (demo.folder / "survey" / image.name).read_bytes()
            ((is_good, text),) = get(session, selector, payload, "image/jpeg")
            assert is_good, text
        assert json.loads(text)["num_images"] == 12
        inbox.wait_for_more(3)
        for image in survey[:12]:
            ((is_good, text),) = get(session, f"trigpoint/test/map?action=remove;name={image.name}")
            assert is_good, text
        assert json.loads(text)["num_images"] == 0


def test_poses_keep_coming_in_a_flood_of_requests(
    demo: Demo, model: FeatureModel, port: int
) -> None:
    image, outcomes, is_over = picture(demo).read_bytes(), Counter[str](), threading.Event()
    limits = peer(port, max_waiting=2, max_rate_hz=1000.0)

    def flood() -> None:
        with connect(port) as session:
            while not is_over.is_set():
                ((is_good, text),) = get(
                    session, "trigpoint/test/localize?camera=phone", image, "image/jpeg"
                )
                outcomes["answered" if is_good else text.split(":")[0]] += 1

    with running(Camera(picture(demo)), demo.map, model, limits), connect(port) as session:
        inbox = Inbox(session)
        flooding = [threading.Thread(target=flood) for _ in range(6)]
        for thread in flooding:
            thread.start()
        try:
            inbox.wait_for_more(10)
            wait_until(lambda: outcomes["answered"] >= 3 and outcomes["busy"] >= 3)
            inbox.wait_for_more(10)
        finally:
            is_over.set()
            for thread in flooding:
                thread.join()
    assert set(outcomes) == {"answered", "busy"}


def test_whatever_a_peer_sends_is_answered_and_poses_keep_coming(
    demo: Demo, model: FeatureModel, port: int
) -> None:
    limits = peer(port, max_rate_hz=1e6, max_payload_bytes=1000)
    with running(Camera(picture(demo)), demo.map, model, limits), connect(port) as session:
        inbox = Inbox(session)

        @settings(
            max_examples=25,
            suppress_health_check=[HealthCheck.function_scoped_fixture],
        )
        @given(
            key=st.sampled_from(["localize", "map", "config", "*", "**", "pose", "status"]),
            parameters=st.one_of(
                st.dictionaries(st.text(max_size=8), st.text(max_size=20), max_size=4),
                st.just({"camera": "phone"}),
                st.just({"action": "add", "camera": "phone"}),
            ),
            payload=st.one_of(st.binary(max_size=2000), st.just(bytes(3000))),
            encoding=st.one_of(st.sampled_from(["image/jpeg", "image/png"]), st.text(max_size=30)),
        )
        def ask(key: str, parameters: dict[str, str], payload: bytes, encoding: str) -> None:
            selector = zenoh.Selector(f"trigpoint/test/{key}", parameters)
            replies = get(session, selector, payload, encoding)
            assert replies
            for is_good, text in replies:
                assert is_good or text != "Timeout"
                assert is_good or "\n" not in text

        inbox.wait_for_more(1)
        ask()
        inbox.wait_for_more(3)


def test_payloads_beyond_any_measure_are_dropped_and_poses_keep_coming(
    demo: Demo, model: FeatureModel, port: int
) -> None:
    limits = peer(port, max_payload_bytes=300_000)
    with (
        running(Camera(picture(demo)), demo.map, model, limits),
        connect(port, transport__shared_memory__enabled=False) as session,
    ):
        inbox = Inbox(session)
        ((is_good, text),) = get(session, "trigpoint/test/map", bytes(400_000))
        assert (is_good, text) == (
            False, "the payload has 400000 bytes; at most 300000 are accepted"
        )  # fmt: skip
        for _ in range(3):
            session.get("trigpoint/test/map", payload=bytes(20_000_000), timeout=0.1)
        inbox.wait_for_more(5)
        ((is_good, text),) = get(session, "trigpoint/test/map")
        assert is_good, text


def open_router(port: int) -> zenoh.Session:
    return open_session(mode="router", listen__endpoints=[f"tcp/127.0.0.1:{port}"])


def endpoint(port: int, mode: str) -> ZenohConfig:
    return ZenohConfig.model_validate(
        {"mode": mode, "connect": [f"tcp/127.0.0.1:{port}"], "multicast_scouting": False}
    )


@pytest.mark.parametrize(
    ("mode", "problem"), [("client", "no Zenoh router answers"), ("peer", "nobody answers")]
)
def test_poses_come_again_when_the_router_does(
    demo: Demo,
    model: FeatureModel,
    port: int,
    mode: str,
    problem: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    problem += f" at tcp/127.0.0.1:{port}"
    with running(Camera(picture(demo)), demo.map, model, endpoint(port, mode)) as sink:
        wait_until(lambda: sink.problem == problem)  # no router at the start
        for _ in range(3):
            with open_router(port) as router:
                Inbox(router).wait_for_more(3)
                wait_until(lambda: sink.problem == "")
                ((is_good, text),) = get(router, "trigpoint/test/map")
                assert is_good, text
            wait_until(lambda: sink.problem == problem)
    said = [record.message for record in caplog.records if record.name.endswith("sinks.zenoh")]
    assert said == [
        f"{problem}; publishing once it can be reached", "Zenoh is there; publishing",
    ] * 3 + [f"{problem}; publishing once it can be reached"]  # fmt: skip


def test_a_peer_that_waits_for_others_to_connect_has_no_problem(
    demo: Demo, model: FeatureModel, port: int
) -> None:
    with running(Camera(picture(demo)), demo.map, model, peer(port)) as sink:
        with connect(port) as session:
            Inbox(session).wait_for_more(3)
        with connect(port) as session:
            Inbox(session).wait_for_more(3)
        assert sink.problem == ""


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_a_session_closed_under_the_daemon_is_opened_again(
    demo: Demo,
    model: FeatureModel,
    port: int,
    mode: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    sessions, open_ = list[zenoh.Session](), zenoh.open

    def remember(settings: zenoh.Config) -> zenoh.Session:
        sessions.append(open_(settings))
        return sessions[-1]

    with open_router(port) as router:
        monkeypatch.setattr(zenoh, "open", remember)
        with running(Camera(picture(demo)), demo.map, model, endpoint(port, mode)) as sink:
            inbox = Inbox(router)
            for number in range(1, 4):
                inbox.wait_for_more(3)
                sessions[-1].close()  # type: ignore[no-untyped-call]
                wait_until(lambda number=number: len(sessions) > number)  # type: ignore[misc]
            inbox.wait_for_more(3)
            wait_until(lambda: sink.problem == "")
            for key in ("pose", "status", "map"):
                ((is_good, text),) = get(router, f"trigpoint/test/{key}")
                assert is_good, text
    said = [record.message for record in caplog.records if record.name.endswith("sinks.zenoh")]
    lost = "the Zenoh session was closed; publishing once it can be reached"
    assert said == [lost, "Zenoh is there; publishing"] * 3


def test_a_session_closed_while_the_router_is_away_is_opened_when_it_is_back(
    demo: Demo, model: FeatureModel, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    sessions, open_ = list[zenoh.Session](), zenoh.open

    def remember(settings: zenoh.Config) -> zenoh.Session:
        sessions.append(open_(settings))
        return sessions[-1]

    router = open_router(port)
    monkeypatch.setattr(zenoh, "open", remember)
    with running(Camera(picture(demo)), demo.map, model, endpoint(port, "client")) as sink:
        Inbox(router).wait_for_more(1)
        router.close()  # type: ignore[no-untyped-call]
        sessions[-1].close()  # type: ignore[no-untyped-call]
        wait_until(lambda: "no Zenoh router answers" in sink.problem)
        with open_router(port) as router:
            Inbox(router).wait_for_more(3)
            wait_until(lambda: sink.problem == "")


def test_without_a_router_a_client_ends_in_order(
    demo: Demo, model: FeatureModel, port: int, caplog: pytest.LogCaptureFixture
) -> None:
    config = ZenohConfig(
        mode="client", connect=(f"tcp/127.0.0.1:{port}",), multicast_scouting=False
    )
    with running(Camera(picture(demo), num_frames=1), demo.map, model, config):
        pass
    assert f"no Zenoh router answers at tcp/127.0.0.1:{port}" in caplog.text
